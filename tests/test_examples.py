"""The examples run as they stand."""

import pytest

from tests.recipe_modules import RECIPES, run

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
    assert SAYS[name] in run(f"examples/{name}")
