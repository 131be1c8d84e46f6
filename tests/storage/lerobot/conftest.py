"""Policies that the real LeRobot wrote."""

import shutil
from pathlib import Path

import pytest

FIXTURES = Path(__file__).parents[2] / "fixtures" / "lerobot"
NAMES = ("flow", "mean_std")


@pytest.fixture
def folder(tmp_path):
    """A copy that a test may damage."""
    shutil.copytree(FIXTURES / "flow", tmp_path / "policy")
    return tmp_path / "policy"
