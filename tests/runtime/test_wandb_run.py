"""A recipe that is run again goes on in the same run, and W&B's own variables count before."""

import pytest

from torchrl_sparse.runtime.wandb_run import wandb_arguments

SETTINGS = {
    "episodes": 3,
    "wandb": {"project": "p", "entity": None, "name": None, "tags": ["a"], "mode": "offline"},
}


@pytest.fixture(autouse=True)
def without_variables(monkeypatch):
    for name in ("WANDB_RUN_ID", "WANDB_DIR"):
        monkeypatch.delenv(name, raising=False)


def test_options_are_passed_on_and_what_is_left_open_is_not(tmp_path):
    made = wandb_arguments(SETTINGS, tmp_path, "lift bac")
    assert {key: made[key] for key in ("project", "tags", "mode", "name")} == {
        "project": "p",
        "tags": ["a"],
        "mode": "offline",
        "name": "lift bac",
    }
    assert "entity" not in made
    assert made["config"] == SETTINGS
    assert made["dir"] == str(tmp_path)


def test_a_run_is_resumed_in_its_folder_alone(tmp_path):
    first, again = (wandb_arguments(SETTINGS, tmp_path / "a", "x") for _ in range(2))
    other = wandb_arguments(SETTINGS, tmp_path / "b", "x")
    assert first["id"] == again["id"] != other["id"]
    assert first["resume"] == "allow"


def test_variables_of_wandb_count_before(tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_RUN_ID", "agent")
    monkeypatch.setenv("WANDB_DIR", "/elsewhere")
    made = wandb_arguments(SETTINGS, tmp_path, "x")
    assert (made["id"], made["dir"]) == ("agent", "/elsewhere")
    assert not list(tmp_path.iterdir())
