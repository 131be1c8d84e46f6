"""The training recipe as a user runs it: interrupted, run again, and its policy loaded."""

import importlib.util
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import hydra
import numpy as np
import pytest
import torch

from torchrl_sparse.evaluation.latency import num_threads
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

RECIPE = Path(__file__).parents[3] / "recipes" / "train_policy.py"
STATE = {"object": 10, "robot0_eef_pos": 3, "robot0_eef_quat_site": 4, "robot0_gripper_qpos": 2}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "lift.h5"
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(4):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = 15
            demo["actions"] = random.uniform(-1, 1, (15, 7))
            for key, size in STATE.items():
                demo[f"obs/{key}"] = random.uniform(-1, 1, (15, size))
    return path


def settings(demos, out):
    sizes = ["network.n_layer=1", "network.n_emb=16", "network.n_head=2", "batch_size=4", "max_steps=400"]
    often = ["checkpoint_every=50", "log_every=10", "lr_warmup_steps=2", "threads=1"]
    return [f"demos={demos}", f"out={out}", *sizes, *often]


def start(arguments):
    command = [sys.executable, str(RECIPE), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    return output


def train_unbroken(arguments):
    """The same training in this process, without the recipe's loop."""
    spec = importlib.util.spec_from_file_location("train_policy", RECIPE)
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    with hydra.initialize_config_dir(str(RECIPE.parent), version_base=None):
        config = hydra.compose("train_policy", arguments)
    trainer = recipe.make_trainer(config)
    with num_threads(1):
        while trainer.step < 400:
            trainer.train_step()
    recipe.save(trainer, config)


def test_a_terminated_training_goes_on_to_the_same_bits(demos, tmp_path):
    broken, unbroken = tmp_path / "broken", tmp_path / "unbroken"
    process = start(settings(demos, broken))
    deadline = time.monotonic() + 120
    while not (broken / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert "stopped by SIGTERM, run again to go on" in finish(process)
    step = torch.load(broken / "checkpoint.pt", weights_only=True)["step"]
    assert 50 <= step < 400
    output = finish(start(settings(demos, broken)))
    assert f"going on from step {step}" in output
    assert "step 400 of 400, finished" in output
    assert len((broken / "log/scalars/train/lr.csv").read_text().splitlines()) >= 39

    train_unbroken(settings(demos, unbroken))
    models = [(out / "policy/model.safetensors").read_bytes() for out in (broken, unbroken)]
    assert models[0] == models[1]
    policy = DiffusionPolicy.from_pretrained(broken / "policy")
    assert (policy.horizon, policy.network.cond_dim, policy.num_inference_steps) == (10, 19, 100)
