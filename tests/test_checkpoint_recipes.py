"""A published checkpoint goes through the recipes as a folder does, and what is made of it lies beside it."""

import pytest

from tests.recipe_modules import run
from tests.storage.published.checkpoints import LowDimPolicy, write_checkpoint


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
