"""The recipe that trains a vision-language-action policy: stopped, run again, and its policy loaded and asked."""

import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict

from tests.fixtures.gguf import write_llama
from tests.training.runs import stop_and_go_on, train_unbroken
from tests.training.vla.rendered import COLOURS, write_demos
from torchrl_sparse import keys
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return write_demos(tmp_path_factory.mktemp("data") / "images.h5")


def test_a_terminated_training_goes_on_to_the_same_bits(demos, tmp_path):
    broken, unbroken = tmp_path / "broken", tmp_path / "unbroken"
    sizes = ["size=tiny", "network.chunk_size=3", "+network.llm.layers=2", "batch_size=2", "max_steps=100"]
    stages = ["grounding.locate_steps=30", "grounding.refer_steps=30"]
    settings = [f"demos={demos}", *sizes, *stages, "checkpoint_every=25", "lr_warmup_steps=2", "threads=1"]
    step, first, second = stop_and_go_on("train_vla", broken, settings)
    assert "3 demonstrations of 3 instructions, 27 steps" in first
    assert "stopped by SIGTERM, run again to resume" in first
    assert 25 <= step < 100
    assert f"resumed from step {step}" in second
    assert "step 100 of 100, finished" in second

    train_unbroken("train_vla", unbroken, settings)
    models = [(out / "policy/model.safetensors").read_bytes() for out in (broken, unbroken)]
    assert models[0] == models[1]
    check_policy(VLAPolicy.from_pretrained(broken / "policy"))

    # from there once more: the first step of a warm-up moves nothing, and sizes are those of the policy
    again = tmp_path / "again"
    no_stages = ["grounding.locate_steps=0", "grounding.refer_steps=0"]
    still = [f"demos={demos}", f"init={broken}/policy", "max_steps=1", "batch_size=2"]
    train_unbroken("train_vla", again, still + no_stages)
    weights = [load_file(out / "policy/model.safetensors") for out in (broken, again)]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[1][name], value) for name, value in weights[0].items())


def check_policy(policy):
    """It knows the instructions' words, grippers as such, and what it was trained for."""
    cameras = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
    assert policy.source == VLASource("LiftNamed", cameras)
    assert set(COLOURS) <= set(policy.tokenizer.words)
    image = torch.zeros(2, 3, 28, 28, dtype=torch.uint8)
    observation = {"image": image, "wrist_image": image, "state": torch.zeros(2, 9)}
    query = TensorDict({"observation": observation, keys.INSTRUCTION: ["lift the red cube"] * 2}, [2])
    chunk = policy(query)[keys.CHUNK]
    assert chunk.shape == (2, 3, 10)
    assert set(chunk[..., 9].flatten().tolist()) <= {-1.0, 0.0, 1.0}
    assert policy.network.config.llm.layers == 2


def test_a_language_model_is_adapted_and_saved_without_it(demos, tmp_path):
    base, out = write_llama(tmp_path / "base.gguf"), tmp_path / "out"
    sizes = ["size=tiny", "network.chunk_size=2", "+network.patch_size=7", f"base={base}", "rank=2"]
    stages = ["grounding.locate_steps=2", "grounding.refer_steps=2"]
    twice = f"demos=[{demos},{demos}]"
    train_unbroken("train_vla", out, [twice, *sizes, *stages, "batch_size=2", "max_steps=6"])
    names = load_file(out / "policy/model.safetensors").keys()
    assert any(name.endswith(".mlp.up_proj.up") for name in names)
    assert not any(name.endswith((".mlp.up_proj.weight", "embed_tokens.weight")) for name in names)
    assert VLAPolicy.from_pretrained(out / "policy", base=base).network.config.num_visual == 32
