"""The cube that moves: along its path, the same way each time, and only while it is on the table."""

import numpy as np
import pytest

from torchrl_sparse import keys
from torchrl_sparse.control.realtime_executor import HoldPose
from torchrl_sparse.envs.moving_lift import PERIOD, SPEED, cube_path
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task


@pytest.fixture(scope="module")
def env():
    env = RobosuiteEnv("LiftMoving")
    yield env
    env.close()


def watch(env, td, steps):
    """f64 [steps, 3] of the cube while the arm stands still."""
    action = HoldPose(env.task.pose_slices())(td.clone())[keys.HOLD]
    positions = []
    for _ in range(steps):
        td = env.step(td.set(keys.ACTION, action))["next"]
        positions.append(env.sim_env.sim.data.body_xpos[env.sim_env.cube_body_id].copy())
    return np.stack(positions)


def start(env, seed):
    env.set_seed(seed)
    return env.reset()


def test_the_cube_keeps_to_its_path(env):
    td = start(env, 0)
    pose = env.sim_env.sim.data.get_joint_qpos(env.sim_env.cube.joints[0]).copy()
    seen = watch(env, td, 60)
    path = cube_path(pose)
    planned = np.stack([path(0.05 * (step + 1))[0] for step in range(60)])
    assert np.abs(seen[:, :2] - planned)[5:].max() < 0.006
    assert np.ptp(seen[:, :2], axis=0).max() > 0.03
    assert np.ptp(seen[10:, 2]) < 0.002


def test_a_seed_or_a_saved_start_fixes_the_motion(env):
    td = start(env, 1)
    state = env.get_initial_state()
    seen = watch(env, td, 12)
    np.testing.assert_array_equal(watch(env, start(env, 1), 12), seen)
    np.testing.assert_array_equal(watch(env, env.reset(initial_state=state), 12), seen)
    assert not np.allclose(watch(env, start(env, 2), 12) - seen, 0, atol=0.005)


def test_nothing_pulls_a_cube_that_is_in_the_air(env):
    td = start(env, 3)
    sim, joint = env.sim_env.sim, env.sim_env.cube.joints[0]
    watch(env, td, 2)
    force = sim.data.xfrc_applied[env.sim_env.cube_body_id]
    assert np.linalg.norm(force[:2]) > 0
    pose = sim.data.get_joint_qpos(joint).copy()
    sim.data.set_joint_qpos(joint, [*pose[:2], 1.2, *pose[3:]])
    sim.forward()
    watch(env, td, 1)
    assert not force.any()


def test_paths_are_smooth_and_as_fast_as_said():
    time = np.arange(0, 10, 0.01)
    for seed in range(20):
        path = cube_path(np.random.default_rng(seed).standard_normal(7))
        position, velocity = (np.stack(each) for each in zip(*map(path, time), strict=True))
        np.testing.assert_allclose(np.gradient(position, 0.01, axis=0)[1:-1], velocity[1:-1], atol=1e-4)
        assert np.abs(velocity).max() <= SPEED[1]
        assert np.abs(velocity).max(axis=0).min() >= SPEED[0] * 0.99
        assert np.abs(position - position[0]).max() <= 2 * SPEED[1] * PERIOD[1] / (2 * np.pi)


def test_it_observes_what_lift_observes():
    moving, still = find_robosuite_task("lift_moving"), find_robosuite_task("lift")
    assert (moving.state_keys, moving.state_dim) == (still.state_keys, still.state_dim)
