"""Five cubes and a ball that circles them: it moves as its start says, and changes nothing but the picture."""

from itertools import combinations

import numpy as np
import pytest
import torch

from torchrl_sparse import keys
from torchrl_sparse.control.realtime_executor import HoldPose
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.envs.crowded_lift import BALL_RADIUS, CROWD, RADII, orbit
from torchrl_sparse.envs.named_lift import SPACING
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_task

JOINTS = ("distractor_x", "distractor_y")


@pytest.fixture(scope="module")
def env():
    env = RobosuiteEnv("lift_crowded", instruction=True)
    yield env
    env.close()


def start(env, seed):
    env.set_seed(seed)
    return env.reset()


def ball(env):
    """f64 [2], m from the table's centre."""
    return np.array([env.sim_env.sim.data.get_joint_qpos(joint) for joint in JOINTS])


def balls(env, td, steps):
    """Where the ball is after each of some steps at rest."""
    places = []
    for _ in range(steps):
        td = env.step(td.set(keys.ACTION, HoldPose(env.task.pose_slices())(td.clone())[keys.HOLD]))["next"]
        places.append(ball(env))
    return np.array(places)


def test_cubes_lie_apart_within_the_balls_round_and_each_is_asked_for(env):
    asked = set()
    for seed in range(5):
        asked.add(start(env, seed)[keys.INSTRUCTION])
        sim = env.sim_env.sim
        bodies = [sim.model.body_name2id(cube.root_body) for cube in env.sim_env.cubes.values()]
        centres = sim.data.body_xpos[bodies][:, :2]
        assert len(centres) == 5
        assert min(np.linalg.norm(a - b) for a, b in combinations(centres, 2)) >= SPACING
        angles = np.linspace(0, 2 * np.pi, 200)
        round_ = np.stack([np.cos(angles), np.sin(angles)], -1) * RADII
        assert np.linalg.norm(centres[:, None] - round_, axis=-1).min() > BALL_RADIUS + 0.022
    assert asked <= {f"lift the {colour} cube" for colour in CROWD}
    assert len(asked) > 1


def test_the_ball_goes_round_as_its_start_says(env):
    places = balls(env, start(env, 3), 6)
    first = ball_at_start(env, 3)
    path = orbit(first)
    # A step's last substep has put the ball where it is at that substep's beginning, 2 ms before the step ends.
    expected = [path(0.05 * step - 0.002) for step in range(1, 7)]
    np.testing.assert_allclose(places, expected, atol=1e-9)
    np.testing.assert_allclose(np.square(places / RADII).sum(axis=1), 1.0)
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).min() > 0.005
    assert abs(ball_at_start(env, 4) - first).max() > 1e-3


def ball_at_start(env, seed):
    start(env, seed)
    return ball(env)


def test_a_restored_start_moves_the_ball_again(env):
    td = start(env, 5)
    state, first = env.get_initial_state(), ball(env)
    places = balls(env, td, 4)
    start(env, 6)
    td = env.reset(initial_state=state)
    np.testing.assert_array_equal(ball(env), first)
    np.testing.assert_array_equal(balls(env, td, 4), places)


def test_the_ball_touches_nothing(env):
    """An episode in which it is put far away comes out the same, to the last bit of everything else."""
    usual = rolled(env, 7)
    env.sim_env._put = lambda place: type(env.sim_env)._put(env.sim_env, np.array([5.0, 5.0]))
    try:
        away = rolled(env, 7)
    finally:
        del env.sim_env._put
    assert torch.equal(usual, away)


def rolled(env, seed):
    td, states = start(env, seed), []
    cube = env.sim_env.sim.data.get_joint_qpos(env.sim_env.cube.joints[0])[:3]
    action = HoldPose(env.task.pose_slices())(td.clone())[keys.HOLD]
    for step in range(15):
        action[:3] += (torch.as_tensor(cube) - td[keys.STATE][10:13]).float() * (step / 15)
        td = env.step(td.set(keys.ACTION, action))["next"]
        states.append(td[keys.STATE])
    return torch.stack(states)


def test_the_expert_lifts_the_named_cube(env):
    assert demonstrate(find_task("lift_crowded"), env, 8).success
