"""The table of tasks: what every entry offers, and one that comes from outside the package."""

import sys

import numpy as np
import pytest
import torch
from torchrl.data import Bounded
from torchrl.envs.utils import check_env_specs

from tests.refusals import refused
from torchrl_sparse.data.demos import Collection, collect
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.simulator import cv2_or_stand_in
from torchrl_sparse.envs.tasks import TASKS, StateTask, find_robosuite_task, find_task
from torchrl_sparse.envs.transforms import make_env


class WalkEnv(SeededEnv):
    """A point on a line that has to reach 1."""

    def __init__(self, *, horizon=20, **kwargs):
        super().__init__(horizon=horizon, **kwargs)
        self._make_specs(1, Bounded(-1.0, 1.0, (1,)))

    def _start(self, seed):
        self._place = -1.0 - seed % 3

    def _advance(self, action):
        self._place += 0.5 * float(action[0])
        return 0.0

    def _observe_state(self):
        return np.array([self._place])

    def _is_solved(self):
        return self._place >= 1


class WalkExpert:
    noise = 0.01

    def __init__(self, rng):
        self._stride = rng.uniform(0.8, 1.0)

    def command(self, state):
        return np.array([self._stride])


@pytest.fixture
def walk(monkeypatch):
    task = StateTask("Walk", "walk", 1, 1, f"{__name__}:WalkEnv", f"{__name__}:WalkExpert")
    monkeypatch.setitem(TASKS, task.name, task)
    return task


def test_a_task_from_outside_is_one_line(walk, tmp_path):
    env = make_env("walk", seeds=[4])
    check_env_specs(env)
    assert env.reset()["history", "state"].tolist() == [[-2.0], [-2.0]]
    summary = collect(tmp_path / "walk.h5", Collection("walk", episodes=2))
    assert (summary.successes, summary.attempts) == (2, 2)
    demos = read_demos(tmp_path / "walk.h5", walk.state_keys, poses=False)
    assert torch.equal(demos.episode(1)["observation", "state"][0], torch.tensor([-2.0]))
    with refused("task"):
        find_task("run")


def test_only_robosuites_tasks_are_found_as_such(walk):
    assert find_robosuite_task("can") is find_task("PickPlaceCan")
    with refused("task"):
        find_robosuite_task("walk")


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_every_entry_offers_what_a_task_has(task):
    assert find_task(task.alias) is find_task(task.name) is task
    assert task.state_dim > 0
    assert task.action_dim > 0
    assert task.state_keys
    assert hasattr(task.demonstrator, "env_args")
    if task.name == "FrankaKitchen":
        with refused("task"):
            task.load_expert()
    else:
        assert task.load_expert().__module__.startswith("torchrl_sparse.envs.experts.")


def test_arms_lie_one_after_the_other_in_the_state():
    transport = find_robosuite_task("transport")
    assert [(p.start, q.start, q.stop) for p, q in transport.pose_slices()] == [(41, 44, 48), (50, 53, 57)]
    seen = transport.proprioception_keys  # of cameras
    assert [(p.start, q.start, q.stop) for p, q in transport.pose_slices(seen)] == [(0, 3, 7), (9, 12, 16)]
    assert transport.state_dim == 59


def test_the_stand_in_for_cv2_is_gone_after_the_import(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)  # importing it fails
    with cv2_or_stand_in():
        import cv2

        assert cv2.__name__ == "cv2"
    assert "cv2" not in sys.modules
