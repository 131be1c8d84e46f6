"""The training recipe as a user runs it: interrupted, run again, and its policy loaded."""

import h5py
import numpy as np
import pytest
import torch

from tests.fixtures.demonstrations import describe, describe_state_task, hands
from tests.training.runs import stop_and_go_on, train_unbroken
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

STATE = {"object": 10, "robot0_gripper_qpos": 2}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.h5"
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(4):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = 15
            demo["actions"] = actions = random.uniform(-1, 1, (15, 7))
            demo["obs/robot0_eef_pos"], demo["obs/robot0_eef_quat_site"] = hands(actions)
            for key, size in STATE.items():
                demo[f"obs/{key}"] = random.uniform(-1, 1, (15, size))
        describe(file)
    return path


def test_a_terminated_training_goes_on_to_the_same_bits(demos, tmp_path):
    broken, unbroken = tmp_path / "broken", tmp_path / "unbroken"
    sizes = ["network.n_layer=1", "network.n_emb=16", "network.n_head=2", "batch_size=4", "max_steps=400"]
    often = ["checkpoint_every=50", "log_every=10", "lr_warmup_steps=2", "threads=1"]
    settings = [f"demos={demos}", *sizes, *often]
    step, first, second = stop_and_go_on("train_policy", broken, settings)
    assert "stopped by SIGTERM, run again to resume" in first
    assert 50 <= step < 400
    assert f"resumed from step {step}" in second
    assert "step 400 of 400, finished" in second
    assert len((broken / "log/scalars/train/lr.csv").read_text().splitlines()) >= 39

    train_unbroken("train_policy", unbroken, settings)
    models = [(out / "policy/model.safetensors").read_bytes() for out in (broken, unbroken)]
    assert models[0] == models[1]
    policy = DiffusionPolicy.from_pretrained(broken / "policy")
    assert (policy.horizon, policy.network.cond_dim, policy.num_inference_steps) == (10, 19, 100)

    # Started from that policy, a training that learns nothing gives it back.
    tuned = tmp_path / "tuned"
    train_unbroken(
        "train_policy", tuned, [f"demos={demos}", f"init={broken}/policy", "max_steps=1", "lr=1e-20"]
    )
    again = DiffusionPolicy.from_pretrained(tuned / "policy").state_dict()
    assert all(torch.equal(again[name], value) for name, value in policy.state_dict().items())


def test_what_is_left_open_is_as_published_for_the_task(tmp_path):
    random, path = np.random.default_rng(0), tmp_path / "demos.h5"
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"] = 30
        demo["actions"], demo["obs/state"] = random.uniform(-3, 1, (30, 2)), random.uniform(0, 9, (30, 16))
        describe_state_task(file, "BlockPush")
    small = ["network.n_layer=1", "network.n_emb=16", "network.n_head=2", "batch_size=4", "max_steps=1"]
    options = ["task=block_push", f"demos={path}", "train.val_ratio=0", *small]
    train_unbroken("train_policy", tmp_path / "run", options)
    policy = DiffusionPolicy.from_pretrained(tmp_path / "run/policy")
    network = policy.network
    assert (network.horizon, network.n_obs_steps, network.cond_dim, network.output_dim) == (5, 3, 16, 2)
    assert network.n_emb == 16
    ends = policy.normalizer.normalize_action(torch.tensor([[-3.0, -3.0], [1.0, 1.0]]))
    torch.testing.assert_close(ends, torch.tensor([[-1.0, -1.0], [1.0, 1.0]]), atol=0.2, rtol=0)
