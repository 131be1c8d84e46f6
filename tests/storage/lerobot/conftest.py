"""Two `multi_task_dit` policies of random weights, and what LeRobot 0.6.1 answers (``reference.safetensors``).

LeRobot wrote them, by `tests/peers/lerobot/write_policies.py` in its own environment; `make test-peers` makes all variants
again and compares.
"""

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
