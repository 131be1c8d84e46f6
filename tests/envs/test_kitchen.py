"""Franka Kitchen: published layout and noise against the simulator's own positions, and what every environment has to do."""

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from tests.envs import published_benchmarks as published
from torchrl_sparse import keys
from torchrl_sparse.envs.kitchen import KitchenEnv

REST = torch.tensor([0.15, -1.77, 1.84, -2.48, 0.26, 0.71, 1.6, 0.04, 0.04])
AMPLITUDE = 0.1 * np.array(
    9 * [0.1] + 2 * [5e-3] + 6 * [5e-4] + 3 * [5e-3] + 3 * [0.1] + 3 * [5e-3] + 3 * [0.1] + [5e-3]
)


def test_the_missing_extra_is_named(monkeypatch):
    published.check_missing_extra_is_named(KitchenEnv, monkeypatch, "gymnasium_robotics", "kitchen")


class TestWithSimulator:
    @pytest.fixture(autouse=True)
    def _simulator(self):
        pytest.importorskip("gymnasium_robotics", reason="needs the extra kitchen")

    @pytest.fixture
    def env(self):
        env = KitchenEnv(seeds=[3])
        yield env
        env.close()

    def test_specs_hold(self, env):
        check_env_specs(env)
        assert env.observation_spec[keys.STATE].shape == (60,)
        assert env.action_spec.shape == (9,)
        assert env.horizon == 280

    def test_seeds_fix_episodes(self):
        published.check_seeds_fix_episodes(KitchenEnv, REST + 0.1)

    def test_horizon_and_errors(self):
        published.check_horizon_and_errors(KitchenEnv, REST)

    def test_state_is_noisy_positions_then_zeros(self, env):
        td, gaps = env.reset(), []
        for _ in range(60):
            state = td[keys.STATE].double().numpy()
            assert not state[30:].any()
            gaps.append(state[:30] - env.sim_env.data.qpos)
            td = env.step(td.set(keys.ACTION, REST))["next"]
        gaps = np.abs(gaps).max(0)
        assert (gaps <= AMPLITUDE + 1e-6).all()
        assert (gaps > 0.8 * AMPLITUDE - 1e-6).all()  # sixty draws come near both ends

    def test_noise_amplitudes_are_those_of_the_simulator(self, env):
        own = 0.1 * env.sim_env.robot_pos_noise_amp
        np.testing.assert_allclose(AMPLITUDE[: len(own)], own)

    def test_joints_go_where_they_are_told(self, env):
        td, target = env.reset(), REST.clone()
        target[0], target[3], target[7:] = 0.5, -2.2, 0.0
        for _ in range(25):
            td = env.step(td.set(keys.ACTION, target))["next"]
        np.testing.assert_allclose(env.sim_env.data.qpos[:7], target[:7], atol=0.03)
        assert (env.sim_env.data.qpos[7:9] < 0.005).all()

    def test_commands_stay_within_bounds(self, env):
        td = env.reset()
        env.step(td.set(keys.ACTION, torch.full((9,), 8.0)))
        ten_rad_a_second = td[keys.STATE][:9].double().numpy() + 10 * 0.08
        np.testing.assert_allclose(
            env.sim_env.data.ctrl,
            np.minimum(ten_rad_a_second, [2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04]),
        )

    def test_tasks_are_counted_once_and_four_are_success(self, env):
        td = env.reset()
        tasks = env._kitchen

        def do(*names):
            for name in names:
                env.sim_env.data.qpos[tasks.OBS_ELEMENT_INDICES[name]] = tasks.OBS_ELEMENT_GOALS[name]
            return env.step(td.set(keys.ACTION, REST))["next"]

        assert int(td[keys.EPISODE_COMPLETED]) == 0
        steps = [do("microwave"), do(), do("kettle", "slide cabinet")]
        env.sim_env.data.qpos[22] = 0.0  # closed again, and still counted
        steps += [do(), do("light switch")]
        assert [float(step["reward"]) for step in steps] == [1, 0, 2, 0, 1]
        assert [int(step[keys.EPISODE_COMPLETED]) for step in steps] == [1, 1, 3, 3, 4]
        assert [bool(step["success"]) for step in steps] == [False, False, False, False, True]
        assert steps[-1]["terminated"]
        assert not steps[-1]["truncated"]
        assert int(env.reset()[keys.EPISODE_COMPLETED]) == 0

    def test_policy_of_the_published_shape_rolls_out_in_a_collector(self):
        steps = published.collected_by_published_policy("kitchen", 10, [10.0] * 9, (-10 * REST).tolist())
        assert steps[keys.HISTORY_STATE].shape == (10, 4, 60)
        assert steps[keys.CHUNK].shape == (10, 13, 9)
        assert steps[keys.QUERIED].flatten().nonzero().flatten().tolist() == [0, 8]

    def test_pictures_show_the_kitchen(self, env):
        env.reset()
        try:
            picture = env.render(height=48, width=64)
        except RuntimeError as error:
            pytest.skip(str(error))
        assert picture.shape == (48, 64, 3)
        assert picture.std() > 10
