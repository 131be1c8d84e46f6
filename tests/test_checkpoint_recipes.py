"""A published checkpoint goes through the recipes as a folder does, and what is made of it lies beside it."""

from pathlib import Path

import pytest

from tests.recipe_modules import ENVIRONMENT, run, run_alone
from tests.storage.published.checkpoints import LowDimPolicy, write_checkpoint
from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.evaluation.results.acceleration import load_acceleration


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    policy = LowDimPolicy(n_layer=1, n_emb=8, n_head=2)
    return write_checkpoint(tmp_path_factory.mktemp("published") / "latest.ckpt", policy)


def test_a_checkpoint_is_calibrated_beside_itself_and_evaluated(checkpoint, tmp_path):
    assert "latest/bac_unified.json: prune rate" in run(
        "calibrate_bac", f"policy={checkpoint}", "methods=[bac_unified]"
    )
    line = run("evaluate_policy", f"policy={checkpoint}", "episodes=1", "horizon=3", f"out={tmp_path}/played")
    assert "success 0/1" in line


def test_a_checkpoint_of_another_task_is_refused_with_both_named(checkpoint, tmp_path):
    refused = run("benchmark", "task=can", f"policy={checkpoint}", f"out={tmp_path}/none", expect=2)
    assert "expected one that was trained for PickPlaceCan, got one for lift_lowdim" in refused
    assert not (tmp_path / "none").exists()


def test_a_checkpoint_is_accelerated_offline_and_then_played(checkpoint, tmp_path):
    """The first without a simulator; the second goes on from what the first left."""
    demos, out = tmp_path / "demos.h5", tmp_path / "fast"
    run("collect_demos", "task=lift", "episodes=2", f"out={demos}")
    options = (
        f"policy={checkpoint}", f"demos={demos}", f"out={out}", "windows=4", "latency_repeats=2", "finalists=1",
        "candidates={samplers: [ddpm4], searched: [ddim2], cached: [], updates: [7], intervals: [2], strides: [40]}",
    )  # fmt: skip
    (tmp_path / "blocked").mkdir()
    (tmp_path / "blocked" / "robosuite.py").write_text("raise ImportError('no simulator here')")
    without = ENVIRONMENT | {"PYTHONPATH": f"{tmp_path}/blocked:{Path(__file__).parents[1]}"}
    assert "no episode was played" in run_alone(
        "accelerate_policy", *options, "episodes=0", environment=without
    )
    assert not (out / "episodes").exists()
    found = load_acceleration(out / "acceleration.json")
    rounded = {name for name in found.candidates if name.endswith(":int8")}
    (searched,) = found.candidates.keys() - rounded - {"dense", "ddpm4", "bac7", "uniform2"}
    assert searched.startswith("ddim_")
    assert rounded <= {"dense:int8", "ddpm4:int8", f"{searched}:int8"}  # none without a compiler
    assert DiffusionPolicy.from_pretrained(out / "policy").fingerprint == found.policy
    timed = (out / "timings.json").read_bytes()
    assert "Dense solved none" in run("accelerate_policy", *options, "episodes=1", "horizon=9")
    assert (out / "timings.json").read_bytes() == timed
    assert len(load_acceleration(out / "acceleration.json").played) == 2
    assert "budget_ms: expected" in run("accelerate_policy", *options, "budget_ms=1e-6", expect=2)
