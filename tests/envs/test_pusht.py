"""Push-T: the published layout against the simulator's own block, and what every environment has to do."""

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from tests.envs import published_benchmarks as published
from torchrl_sparse import keys
from torchrl_sparse.envs.pusht import KEYPOINTS, PushTEnv, published_start

AWAY = torch.tensor([256.0, 40.0])


def test_the_missing_extra_is_named(monkeypatch):
    published.check_missing_extra_is_named(PushTEnv, monkeypatch, "gym_pusht", "pusht")


def test_another_start_per_seed_and_the_same_as_published():
    assert np.array_equal(published_start(5), published_start(5))
    starts = np.stack([published_start(seed) for seed in range(50)])
    assert len(np.unique(starts[:, 0])) > 40
    assert ((starts[:, :2] >= 50) & (starts[:, :2] < 450)).all()
    assert ((starts[:, 2:4] >= 100) & (starts[:, 2:4] < 400)).all()


class TestWithSimulator:
    @pytest.fixture(autouse=True)
    def _simulator(self):
        pytest.importorskip("gym_pusht", reason="needs the extra pusht")

    def test_specs_hold(self):
        env = PushTEnv()
        check_env_specs(env)
        assert env.observation_spec[keys.STATE].shape == (20,)
        assert env.action_spec.shape == (2,)
        assert env.horizon == 300

    def test_seeds_fix_episodes(self):
        published.check_seeds_fix_episodes(PushTEnv, AWAY)

    def test_horizon_and_errors(self):
        published.check_horizon_and_errors(PushTEnv, AWAY)

    def test_state_is_the_keypoints_then_the_agent(self):
        env = PushTEnv(seeds=[3])
        td = env.reset()
        for _ in range(10):
            td = env.step(td.set(keys.ACTION, torch.tensor([300.0, 260.0])))["next"]
            state = td[keys.STATE].double().numpy()
            block = env.sim_env.block
            expected = [block.local_to_world(tuple(point)) for point in KEYPOINTS]
            np.testing.assert_allclose(state[:18].reshape(9, 2), expected, atol=1e-3)
            np.testing.assert_allclose(state[18:], env.sim_env.agent.position, atol=1e-3)

    def test_keypoints_are_those_that_the_published_code_samples(self):
        points = drawn_block()
        rng = np.random.default_rng(0)
        chosen = [points[rng.choice(len(points))]]
        for _ in range(8):
            gaps = np.linalg.norm(points[:, None] - np.stack(chosen), axis=-1).min(1)
            chosen.append(points[gaps.argmax()])
        expected = np.stack(chosen) + rng.uniform(0, 1, (9, 2))
        np.testing.assert_allclose(KEYPOINTS, expected, atol=1e-8)

    def test_the_agent_goes_where_it_is_told(self):
        env = PushTEnv(seeds=[3])
        td = env.reset()
        for _ in range(20):
            td = env.step(td.set(keys.ACTION, AWAY))["next"]
        torch.testing.assert_close(td[keys.STATE][18:], AWAY, atol=1.0, rtol=0)

    def test_a_block_on_its_goal_is_success_and_terminates(self):
        env = PushTEnv(seeds=[3], horizon=1)
        td = env.reset()
        assert not td[keys.SUCCESS]
        env.sim_env.block.angle = np.pi / 4
        env.sim_env.block.position = (256, 256)
        td = env.step(td.set(keys.ACTION, AWAY))["next"]
        assert all(td[key].item() for key in ("success", "terminated", "done"))
        assert not td["truncated"]
        torch.testing.assert_close(td["reward"], torch.ones(1))

    def test_reward_is_the_share_of_the_goal_that_is_covered(self):
        env = PushTEnv(seeds=[3])
        td = env.reset()
        env.sim_env.block.angle = np.pi / 4
        env.sim_env.block.position = (256 + 15 / np.sqrt(2), 256 + 15 / np.sqrt(2))  # 15 pixels along its bar
        reward = float(env.step(td.set(keys.ACTION, AWAY))["next", "reward"])
        bar, stem = 120 * 30, 30 * 90
        expected = (bar - 15 * 30 + stem / 2) / (bar + stem) / 0.95
        assert reward == pytest.approx(expected, abs=0.02)

    def test_policy_of_the_published_shape_rolls_out_in_a_collector(self):
        steps = published.collected_by_published_policy("pusht", 20, [1 / 256] * 2, [-1.0] * 2)
        assert steps[keys.HISTORY_STATE].shape == (20, 2, 20)
        assert steps[keys.CHUNK].shape == (20, 15, 2)
        assert steps[keys.QUERIED].flatten().nonzero().flatten().tolist() == [0, 8, 16]
        assert (steps[keys.EPISODE_SEED] == 100000).all()
        assert len(steps["next", keys.STATE][:, 18:].unique(dim=0)) > 10

    def test_pictures_show_the_block(self):
        pytest.importorskip("cv2", reason="needs a GL library")
        env = PushTEnv(seeds=[3])
        env.reset()
        picture = env.render(height=64, width=80)
        assert picture.shape == (64, 80, 3)
        assert picture.std() > 10


def drawn_block() -> np.ndarray:
    """Pixels of a block that is drawn upright, relative to its position, row by row, f64 [n, 2]."""
    import pygame
    import pymunk
    from gym_pusht.envs.pusht import PushTEnv as Simulator
    from gym_pusht.envs.pymunk_override import DrawOptions

    space, screen = pymunk.Space(), pygame.Surface((512, 512))
    Simulator.add_tee(space, (256, 300), 0)
    screen.fill((255, 255, 255))
    space.debug_draw(DrawOptions(screen))
    column, row = np.nonzero((pygame.surfarray.array3d(screen) != 255).any(-1))
    order = np.lexsort((column, row))
    return np.stack([column, row], -1)[order].astype(float) - (256, 300)
