"""A suite of LIBERO, episode by episode: of scenes that stand in for LIBERO's, and of its own where it is installed."""

import importlib.util

import numpy as np
import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.envs.test_libero import StillScene
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.envs import libero_suite
from torchrl_sparse.envs.libero import SUITES
from torchrl_sparse.envs.libero_suite import make_suite_env, scene_of
from torchrl_sparse.envs.seeds import evaluation_seeds

needs_libero = pytest.mark.skipif(importlib.util.find_spec("libero") is None, reason="no LIBERO")
SOLVED_AT = 3
EPISODE = (keys.EPISODE_SEED, keys.EPISODE_STEP)


class Scene(StillScene):
    """One task, solved at its third step; its picture says which task, state and seed it shows, its state how far it is."""

    scene_seed = init_state_id = None

    def __init__(self, task_id, image_size):
        super().__init__(image_size)
        self.task_id = task_id
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        self.steps = 0
        return self._look()

    def _look(self):
        td = super()._reset()
        state = 255 if self.init_state_id is None else self.init_state_id
        td[keys.IMAGE][:] = torch.tensor([self.task_id, state, self.scene_seed % 256])[:, None, None]
        td[keys.STATE] = torch.full((8,), float(self.steps))
        return td.set(keys.SUCCESS, torch.tensor([self.steps >= SOLVED_AT]))

    def _step(self, tensordict):
        self.steps += 1
        self.asked = tensordict[keys.ACTION]
        over = torch.zeros(1, dtype=torch.bool)
        return self._look().set("reward", self.asked.mean(-1, keepdim=True)).set("done", over)


@pytest.fixture
def made(monkeypatch):
    made = []

    def make(suite, task_id, *, image_size, as_released, init_state_mode):
        made.append((suite, task_id, image_size, as_released, init_state_mode))
        return TransformedEnv(Scene(task_id, image_size), Compose(InitTracker()))

    monkeypatch.setattr(libero_suite, "make_libero_env", make)
    return made


def test_the_test_seeds_are_the_published_episodes_once():
    scenes = [scene_of(seed) for seed in evaluation_seeds("test", 0, 500)]
    assert scenes[:12] == [*((task, 0) for task in range(10)), (0, 1), (1, 1)]
    assert len({*scenes}) == 500
    assert {state for _, state in scenes} == {*range(50)}
    for seed in (evaluation_seeds("test", 500, 1)[0], 200_000):
        with refused("seed"):
            scene_of(seed)
    drawn = {scene_of(seed) for seed in evaluation_seeds("development", 0, 1000)}
    assert drawn == {(task, None) for task in range(10)}


def test_an_episode_is_the_scene_of_its_seed(made):
    seeds = [210_000, 210_010, 210_013, 100_003]
    env = make_suite_env("libero_goal", image_size=28, as_released=True, horizon=9, seeds=seeds)
    assert env.base_env.horizon == 9
    first = env.reset()
    assert first[keys.IS_INIT].all()
    assert [first[key].item() for key in EPISODE] == [210_000, 0]
    shown = [first, *(env.reset() for _ in seeds[1:])]
    pictures = [td[keys.IMAGE][:, 0, 0].tolist() for td in shown]
    assert pictures == [[0, 0, 80], [0, 1, 90], [3, 1, 93], [3, 255, 163]]
    assert [task for _, task, *_ in made] == [0, 3]  # made again where the task changes alone
    assert made[0] == ("libero_goal", 0, 28, True, "fixed")


def test_an_episode_ends_with_success_or_at_the_horizon(made):
    check_env_specs(make_suite_env("libero_spatial", image_size=28, seeds=[7]))
    steps = make_suite_env("libero_spatial", image_size=28, seeds=[7]).rollout(9)
    assert steps[keys.STATE][:, 0].tolist() == [0, 1, 2]
    assert steps["next", keys.STATE][:, 0].tolist() == [1, 2, 3]
    assert steps["next", "terminated"].flatten().tolist() == [False, False, True]
    torch.testing.assert_close(steps["next", "reward"], steps[keys.ACTION].mean(-1, keepdim=True))
    steps = make_suite_env("libero_spatial", image_size=28, horizon=2, seeds=[7]).rollout(9)
    assert steps["next", "truncated"].flatten().tolist() == [False, True]
    assert not steps["next", "terminated"].any()


def test_seeds_beyond_the_states_are_refused_before_anything_is_made(made):
    with refused("seed"):
        make_suite_env("libero_goal", seeds=evaluation_seeds("test", 0, 501))
    with refused("suite"):
        make_suite_env("libero_90", seeds=[1])
    assert not made


@needs_libero
@pytest.mark.parametrize(("suite", "seed"), [("libero_goal", 100_000), ("libero_10", 210_002)])
def test_an_episode_comes_of_its_seed_alone(suite, seed):
    """Also where LIBERO draws from numpy's global generator, whatever was drawn of it before."""

    def play(global_seed):
        np.random.seed(global_seed)  # noqa: NPY002
        env = make_suite_env(suite, image_size=28, horizon=2, seeds=[seed])
        np.random.seed(global_seed)  # noqa: NPY002 - making one draws
        action = torch.linspace(-1, 1, 7)
        steps = env.rollout(2, lambda td: td.set(keys.ACTION, action))
        env.close()
        assert np.random.randint(9) == np.random.RandomState(global_seed).randint(9)  # noqa: NPY002
        return steps

    first, again = play(1), play(2)
    for key in (keys.IMAGE, keys.WRIST_IMAGE, keys.STATE, keys.EEF_VEL):
        assert torch.equal(first[key], again[key])
        assert torch.equal(first["next", key], again["next", key])
    assert suite in SUITES
    assert first[keys.EPISODE_SEED].unique().tolist() == [seed]
