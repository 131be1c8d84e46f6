"""The two arms of TwoArmTransport decide by what the state shows, and meet to hand the hammer over."""

import h5py
import numpy as np
import pytest
import torch

from torchrl_sparse import keys
from torchrl_sparse.data.demos import Collection, collect, read_initial_state
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Hand, downward
from torchrl_sparse.envs.experts.operators import OPERATORS
from torchrl_sparse.envs.experts.two_arm_transport import Hammer
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.rotations import pose_to_absolute

TASK = "TwoArmTransport"
OFFERED = np.array([0.0, -0.01, 1.08])
ALONG_Y = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0)  # wxyz of a hammer whose head points to the taker


@pytest.fixture(scope="module")
def env():
    made = RobosuiteEnv(TASK)
    yield made
    made.close()


@pytest.fixture
def expert(env):
    env.set_seed(3)
    env.reset()
    return find_task(TASK).load_expert()(
        env.sim_env, OPERATORS["proficient"][0].draw(np.random.default_rng(0))
    )


def put(expert, thing, position, quaternion=(1.0, 0.0, 0.0, 0.0)):
    sim = expert.sim_env.sim
    joint = expert.sim_env.transport.objects[thing].joints[0]
    sim.data.set_joint_qpos(joint, np.array([*position, *quaternion]))
    sim.forward()


def seen(expert, thing):
    return expert.body(expert.sim_env.transport.objects[thing].root_body)[0]


def hands(expert, giver, taker):
    """Makes the expert see these hands."""
    expert.hand = lambda arm=0: (giver, taker)[arm]


def hand(position, opening, yaw=0.5 * np.pi):
    return Hand(np.array(position), downward(yaw), np.zeros(3), opening)


def towards(expert, arm):
    """Unit vector of where an arm is sent, and its gripper."""
    waypoint = expert.waypoints()[arm]
    way = waypoint.position - expert.hand(arm).position
    return way / np.linalg.norm(way), waypoint.gripper


def sideways(expert, arm, thing):
    """Cosine between an arm's horizontal way and the direction of a thing; ways lead round the arm's base."""
    way = expert.waypoints()[arm].position - expert.hand(arm).position
    to = np.asarray(thing) - expert.hand(arm).position
    return way[:2] @ to[:2] / np.linalg.norm(way[:2]) / np.linalg.norm(to[:2])


# -- the hammer ---------------------------------------------------------------------------------


@pytest.mark.parametrize("pitch", [-0.5, 0.0, 0.3])
@pytest.mark.parametrize("hammer_yaw", np.linspace(0.1, np.pi - 0.1, 7))
@pytest.mark.parametrize("hand_yaw", [-1.6, 1.6])
def test_a_hand_across_the_handle_points_down_with_its_fingers_square_to_it(pitch, hammer_yaw, hand_yaw):
    along = np.array([np.cos(pitch) * np.cos(hammer_yaw), np.cos(pitch) * np.sin(hammer_yaw), np.sin(pitch)])
    across = Hammer(np.zeros(3), np.zeros(3), along).across(hand(np.zeros(3), 0.08, hand_yaw))
    np.testing.assert_allclose(across[:, 2], [0.0, 0.0, -1.0], atol=1e-12)
    assert across[:, 0] @ along == pytest.approx(0.0)
    assert across[:, 0] @ downward(hand_yaw)[:, 0] > -1e-9  # the nearer of both ways


def test_a_taker_that_leans_holds_its_palm_away_from_the_giver():
    hammer = Hammer(np.zeros(3), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    across = hammer.across(hand(np.zeros(3), 0.08, -0.5 * np.pi), lean=0.3)
    np.testing.assert_allclose(
        across[:, 2], [0.0, -np.sin(0.3), -np.cos(0.3)], atol=1e-12
    )  # its fingers point back
    np.testing.assert_allclose(np.abs(across[:, 0]), [1.0, 0.0, 0.0], atol=1e-12)


def test_held_needs_closed_fingers_anywhere_on_the_handle():
    hammer = Hammer(np.array([0.1, 0.0, 1.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    assert hammer.held_by(hand([0.1, 0.08, 1.0], 0.031))
    assert hammer.held_by(hand([0.11, -0.09, 1.0], 0.03))
    assert not hammer.held_by(hand([0.1, 0.08, 1.0], 0.06))
    assert not hammer.held_by(hand([0.1, 0.14, 1.0], 0.03))  # beyond its end
    assert hammer.distance(hand([0.1, 0.13, 1.04], 0.0)) == pytest.approx(0.05)


# -- decisions ----------------------------------------------------------------------------------


def test_first_one_goes_for_the_lid_and_the_other_for_the_trash(expert):
    assert sideways(expert, 0, seen(expert, "lid")) > 0.8
    assert sideways(expert, 1, seen(expert, "trash")) > 0.8
    assert [waypoint.gripper for waypoint in expert.waypoints()] == [OPEN, OPEN]


def test_a_hand_in_a_bin_rises_before_it_leaves(expert):
    trash_bin = expert.sim_env.transport.trash_bin_pos
    put(expert, "trash", [*trash_bin[:2], 0.83])
    hands(expert, expert.hand(0), hand([*trash_bin[:2], 0.86], 0.08, -0.5 * np.pi))
    way, gripper = towards(expert, 1)
    assert way[2] > 0.95
    assert gripper == OPEN


def test_the_lid_put_aside_makes_way_for_the_hammer(expert):
    put(expert, "lid", [-0.22, -0.45, 0.82])
    assert sideways(expert, 0, seen(expert, "payload")) > 0.8
    put(expert, "lid", [-0.05, -0.45, 0.96])  # it still covers the bin
    assert sideways(expert, 0, seen(expert, "lid")) > 0.8


def test_the_taker_comes_for_an_offered_hammer_once_the_trash_is_gone(expert):
    put(expert, "lid", [-0.22, -0.45, 0.82])
    put(expert, "payload", OFFERED, ALONG_Y)
    giver = hand([0.0, OFFERED[1] - 0.03, OFFERED[2]], 0.03)
    hands(expert, giver, hand([0.1, 0.4, 1.15], 0.08, -0.5 * np.pi))
    assert sideways(expert, 1, seen(expert, "trash")) > 0.8
    trash_bin = expert.sim_env.transport.trash_bin_pos
    put(expert, "trash", [*trash_bin[:2], 0.83])
    assert sideways(expert, 1, seen(expert, "payload") + np.array([0.0, 0.075, 0.0])) > 0.8


def test_the_giver_lets_go_when_the_taker_holds_and_the_taker_leaves_when_the_giver_is_off(expert):
    put(expert, "lid", [-0.22, -0.45, 0.82])
    put(expert, "payload", OFFERED, ALONG_Y)
    giver = hand([0.0, OFFERED[1] - 0.03, OFFERED[2]], 0.03)
    taker = hand([0.0, OFFERED[1] + 0.075, OFFERED[2]], 0.06, -0.5 * np.pi)
    hands(expert, giver, taker)
    assert expert.waypoints()[0].gripper == CLOSED
    taker = hand(taker.position, 0.03, -0.5 * np.pi)
    hands(expert, giver, taker)
    letting_go, waiting = expert.waypoints()
    assert (letting_go.gripper, waiting.gripper) == (OPEN, CLOSED)
    np.testing.assert_array_equal(letting_go.position, giver.position)
    np.testing.assert_array_equal(waiting.position, taker.position)
    hands(expert, hand(giver.position, 0.08), taker)  # open: straight up, off the handle
    np.testing.assert_allclose(towards(expert, 0)[0], [0.0, 0.0, 1.0])
    hands(expert, hand(giver.position + np.array([0.0, 0.0, 0.09]), 0.08), taker)
    assert sideways(expert, 1, seen(expert, "target_bin")) > 0.8
    assert towards(expert, 0)[0][1] < -0.9


def test_the_taker_drops_the_hammer_between_the_walls_only(expert):
    bin_ = expert.sim_env.transport.target_bin_pos
    giver = expert.hand(0)
    for shift, gripper in ((0.0, OPEN), (0.2, CLOSED)):
        put(expert, "payload", [bin_[0] + shift, bin_[1], 0.87], ALONG_Y)
        hands(expert, giver, hand([bin_[0] + shift, bin_[1] + 0.05, 0.87], 0.03, -0.5 * np.pi))
        assert expert.waypoints()[1].gripper == gripper


# -- as an environment, and as data -------------------------------------------------------------


def test_environment_has_the_published_sizes():
    env = make_env("transport")
    assert env.reset()[keys.HISTORY_STATE].shape == (2, 59)
    assert env.action_spec.shape == (20,)
    env.close()


@pytest.mark.slow
def test_a_demonstration_is_read_as_training_data_and_replays_to_success(env, tmp_path):
    path = tmp_path / "transport.h5"
    summary = collect(path, Collection(TASK, episodes=1, seed=30_000, keep_failures=True), env=env)
    assert summary.successes == 1
    episode = read_demos(path, env.task.state_keys).episode(0)
    assert episode["observation", "state"].shape == (summary.mean_length, 59)
    assert episode["action"].shape == (summary.mean_length, 20)
    with h5py.File(path) as file:
        executed = file["data/demo_0/executed_actions"][()]
    td = env.reset(initial_state=read_initial_state(path, 0))
    for command in executed:
        td[keys.ACTION] = torch.as_tensor(pose_to_absolute(command), dtype=torch.float32)
        td = env.step(td)["next"]
    assert td[keys.SUCCESS]
