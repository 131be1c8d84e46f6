"""Block pushing: the published layout against the simulator's own bodies, rewards, and what every environment has to do."""

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from tests.envs import published_benchmarks as published
from torchrl_sparse import keys
from torchrl_sparse.envs.block_push import BlockPushEnv, way_of
from torchrl_sparse.envs.block_push_scene import WORKSPACE, published_start

STAY = torch.zeros(2)


def test_the_missing_extra_is_named(monkeypatch):
    published.check_missing_extra_is_named(BlockPushEnv, monkeypatch, "pybullet", "blockpush")


def test_starts_keep_the_published_distances():
    starts = [published_start(seed) for seed in range(100)]
    blocks, targets = (np.stack([getattr(start, name) for start in starts]) for name in ("blocks", "targets"))
    assert (np.abs(np.diff(blocks[..., 0], axis=1)) > 0.1).all()
    assert (np.abs(blocks[..., :2] - [0.4, -0.2]) <= [0.1, 0.15]).all()
    assert (np.abs(np.abs(targets[..., :2] - [0.4, 0.2]) - [0.12, 0]) <= [0.005, 0.0075]).all()
    assert (np.sign(targets[:, 0, 0] - 0.4) == -np.sign(targets[:, 1, 0] - 0.4)).all()
    assert 20 < (targets[:, 0, 0] > 0.4).sum() < 80


class TestWithSimulator:
    @pytest.fixture(autouse=True)
    def _simulator(self):
        pytest.importorskip("pybullet", reason="needs the extra blockpush")

    @pytest.fixture
    def env(self):
        env = BlockPushEnv(seeds=[3])
        yield env
        env.close()

    def test_specs_hold(self, env):
        check_env_specs(env)
        assert env.observation_spec[keys.STATE].shape == (16,)
        assert env.action_spec.shape == (2,)
        assert env.horizon == 350

    def test_a_delta_beyond_its_bounds_counts_as_the_bound(self, env):
        ends = []
        for far in (0.1, 5.0):
            env.set_seed(3)
            td = env.reset()
            ends.append(
                env.step(td.set(keys.ACTION, torch.tensor([far, -far])))["next", "observation", "state"]
            )
        assert torch.equal(*ends)

    def test_seeds_fix_episodes(self):
        published.check_seeds_fix_episodes(BlockPushEnv, torch.tensor([0.03, 0.05]))

    def test_horizon_and_errors(self):
        published.check_horizon_and_errors(BlockPushEnv, STAY)

    def test_a_pushed_block_ends_the_same_whatever_was_before(self, env):
        first = push_first_block(env, env.reset())
        env.reset()
        assert torch.equal(first, push_first_block(env, env.reset()))

    def test_state_is_laid_out_as_published(self, env):
        td = env.reset()
        td = env.step(td.set(keys.ACTION, torch.tensor([0.02, 0.05])))["next"]
        state, start = td[keys.STATE].double().numpy(), published_start(3)
        poses = [env.scene.client.getBasePositionAndOrientation(body) for body in env.scene.blocks]
        for index, (position, quaternion) in enumerate(poses):
            np.testing.assert_allclose(state[3 * index : 3 * index + 2], position[:2], atol=1e-6)
            yaw = 2 * np.arctan2(quaternion[2], quaternion[3])
            assert np.cos(2 * (state[3 * index + 2] - yaw)) == pytest.approx(1.0, abs=1e-4)
            np.testing.assert_allclose(position[:2], start.blocks[index, :2], atol=1e-3)
            assert position[2] == pytest.approx(0.019, abs=1e-3)
        tip = env.scene.client.getBasePositionAndOrientation(env.scene.tip)[0]
        np.testing.assert_allclose(state[6:8], tip[:2], atol=1e-6)
        np.testing.assert_allclose(state[8:10], [0.32, -0.35], atol=1e-4)
        np.testing.assert_allclose(state[[10, 11, 13, 14]], start.targets[:, :2].ravel(), atol=1e-6)
        np.testing.assert_allclose(state[[12, 15]], start.targets[:, 2] % np.pi, atol=1e-6)

    def test_the_tip_lags_behind_its_target_and_arrives(self, env):
        td = env.step(env.reset().set(keys.ACTION, torch.tensor([0.05, 0.0])))["next"]
        lag = float(td[keys.STATE][8] - td[keys.STATE][6])
        assert 0.05 * 0.9**24 < lag < 0.01
        td = env.step(td.set(keys.ACTION, STAY))["next"]
        torch.testing.assert_close(td[keys.STATE][6:8], td[keys.STATE][8:10], atol=1e-3, rtol=0)

    def test_the_target_stays_in_the_workspace(self, env):
        td = env.reset()
        for _ in range(12):
            td = env.step(td.set(keys.ACTION, torch.tensor([-0.1, 0.1])))["next"]
        torch.testing.assert_close(
            td[keys.STATE][8:10], torch.tensor([WORKSPACE[0, 0], WORKSPACE[1, 1]]).float()
        )

    def test_the_tip_pushes_blocks(self, env):
        before = env.reset()[keys.STATE][:2]
        after = push_first_block(env, env.reset())[:2]
        assert 0.05 < float(after[1] - before[1]) < 0.3

    def test_rewards_and_levels_are_the_published_ones(self, env):
        td = env.reset()
        target = env.targets

        def step():
            return env.step(td.set(keys.ACTION, STAY))["next"]

        assert int(td[keys.EPISODE_COMPLETED]) == 0
        env.scene.place_block(0, target[1])
        steps = [step(), step()]
        assert [round(float(s["reward"]), 2) for s in steps] == [0.49, 0.0]
        assert not steps[0]["success"]
        env.scene.place_block(1, target[1] + [0.045, 0, 0])  # both in the same square
        steps += [step()]
        assert round(float(steps[-1]["reward"]), 2) == 0.49
        assert not steps[-1]["success"]
        env.scene.place_block(1, target[0] + [0.0, 0.1, 0])  # neither in it
        assert float(step()["reward"]) == 0
        env.scene.place_block(1, target[0] + [0.0, 0.045, 0])
        steps += [step()]
        assert round(float(steps[-1]["reward"]), 2) == 0.51
        assert all(steps[-1][key].item() for key in ("success", "terminated", "done"))
        assert not steps[-1]["truncated"]
        assert [int(s[keys.EPISODE_COMPLETED]) for s in steps] == [1, 1, 1, 2]

    @pytest.mark.parametrize(("block", "square"), [(0, 0), (0, 1), (1, 0), (1, 1)])
    def test_the_way_is_which_block_first_entered_which_square(self, env, block, square):
        steps = [env.reset()]

        def step():
            steps.append(env.step(steps[-1].clone().set(keys.ACTION, STAY))["next"])

        step()
        env.scene.place_block(block, env.targets[square])
        step()
        env.scene.place_block(1 - block, env.targets[1 - square])
        step()
        way = 2 * block + square
        assert [int(s[keys.EPISODE_WAY]) for s in steps] == [-1, -1, way, way]
        states = torch.stack([s[keys.STATE] for s in steps]).numpy()
        assert [way_of(states[: i + 1]) for i in range(4)] == [-1, -1, way, way]
        assert int(env.reset()[keys.EPISODE_WAY]) == -1

    def test_policy_of_the_published_shape_rolls_out_in_a_collector(self):
        steps = published.collected_by_published_policy("block_push", 6, [20.0] * 2, [0.0] * 2)
        assert steps[keys.HISTORY_STATE].shape == (6, 3, 16)
        assert steps[keys.CHUNK].shape == (6, 3, 2)
        assert steps[keys.QUERIED].all()
        assert len(steps["next", keys.STATE][:, 6:8].unique(dim=0)) == 6

    def test_pictures_show_the_scene(self, env):
        env.reset()
        picture = env.render(height=48, width=64)
        assert picture.shape == (48, 64, 3)
        assert picture.std() > 10


def push_first_block(env, td) -> torch.Tensor:
    """The state after the tip went round behind the first block and then 0.16 m towards +y."""
    x, y = td[keys.STATE][:2].tolist()
    for goal in ((x, -0.42), (x, y - 0.06), (x, y + 0.1)):
        for _ in range(16):
            gap = torch.tensor(goal) - td[keys.STATE][8:10]
            td = env.step(td.set(keys.ACTION, gap.clamp(-0.02, 0.02)))["next"]
    return td[keys.STATE]
