"""The examples run as they stand."""

import subprocess
import sys

import pytest

from tests.recipe_modules import ENVIRONMENT, RECIPES

SAYS = {
    "robot_loop": "of 20 deadlines of 50 ms missed",
    "accelerate_one_policy": "of the FLOPs",
    "your_planner": "0.50 of the blocks are skipped",
    "collect": "32 steps, ",
}


def test_every_example_is_run_here():
    assert {path.stem for path in (RECIPES / "examples").glob("*.py")} == SAYS.keys()


@pytest.mark.parametrize("name", SAYS)
def test_it_runs(name):
    command = [sys.executable, str(RECIPES / "examples" / f"{name}.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert SAYS[name] in done.stdout
