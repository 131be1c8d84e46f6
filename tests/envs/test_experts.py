"""Scripted experts succeed, label by the state alone and recover; disturbances touch execution only."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.envs.experts.base import DOWNWARD, Hand, downward, nearest
from torchrl_sparse.envs.experts.disturbance import Disturbance
from torchrl_sparse.envs.experts.nut_assembly_square import grasp_yaw
from torchrl_sparse.envs.experts.operators import OPERATORS, draw_operator
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, find_task
from torchrl_sparse.rotations import pose_to_absolute

EXPERTS = [name for name, task in TASKS.items() if isinstance(task, RobosuiteTask)]
PROFICIENT = OPERATORS["proficient"][0]
STILL = replace(PROFICIENT, noise=0.0, bump=0.0, slip=0.0, hesitation=0.0)


@pytest.fixture(scope="module")
def envs():
    made = {task: RobosuiteEnv(task) for task in EXPERTS}
    yield made
    for env in made.values():
        env.close()


def style(seed=0):
    return PROFICIENT.draw(np.random.default_rng(seed))


def execute(env, command):
    action = torch.as_tensor(pose_to_absolute(command), dtype=torch.float32)
    return env.step(env.reset_td.set("action", action))["next"]


def start(env, seed):
    env.set_seed(seed)
    env.reset_td = env.reset()


@pytest.mark.parametrize(
    ("task", "quality"),
    [
        *((task, "proficient") for task in EXPERTS if task != "TwoArmTransport"),
        ("Lift", "mixed"),
        ("PickPlaceCan", "mixed"),
        ("NutAssemblySquare", "recovering"),
        pytest.param("TwoArmTransport", "mixed", marks=pytest.mark.slow),
    ],
)
def test_succeeds_within_the_horizon(envs, task, quality):
    episode = demonstrate(find_task(task), envs[task], seed=30_000, quality=quality)
    assert episode.success
    assert episode.operator in {operator.name for operator in OPERATORS[quality]}


@pytest.mark.parametrize("task", EXPERTS)
def test_label_depends_on_the_state_and_the_style_only(envs, task):
    env = envs[task]
    start(env, 4)
    expert = find_task(task).load_expert()(env.sim_env, style())
    for _ in range(25):
        execute(env, expert.command())
    np.testing.assert_array_equal(
        find_task(task).load_expert()(env.sim_env, style()).command(), expert.command()
    )


@pytest.mark.parametrize("task", EXPERTS)
def test_target_is_one_clipped_step_from_the_hand(envs, task):
    env = envs[task]
    start(env, 5)
    expert = find_task(task).load_expert()(env.sim_env, style())
    for _ in range(20):
        hand, command = expert.hand(), expert.command()
        assert np.linalg.norm(command[:3] - hand.position) <= expert.style.reach + 1e-9
        assert abs(command[6]) == 1
        execute(env, command)


def test_lift_grasps_again_after_the_cube_was_dropped(envs):
    env = envs["Lift"]
    start(env, 6)
    expert = find_task("Lift").load_expert()(env.sim_env, style())
    dropped = False
    for _ in range(120):
        command = expert.command()
        if not dropped and env.sim_env.sim.data.body_xpos[env.sim_env.cube_body_id][2] > 0.835:
            dropped = True
            while expert.hand().opening < 0.06:
                execute(env, np.array([*command[:6], -1.0]))
            command = expert.command()
        if execute(env, command)["success"]:
            break
    else:
        pytest.fail("the cube was not lifted")
    assert dropped


def test_can_that_has_toppled_is_grasped_across_its_axis(envs):
    env = envs["PickPlaceCan"]
    start(env, 7)
    can = env.sim_env.objects[env.sim_env.object_id]
    joint = env.sim_env.sim.data.get_joint_qpos(can.joints[0])
    lying = np.array(
        [*joint[:2], 0.85, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]
    )  # turned about x: its axis along y
    env.sim_env.sim.data.set_joint_qpos(can.joints[0], lying)
    env.sim_env.sim.forward()
    expert = find_task("PickPlaceCan").load_expert()(env.sim_env, style())
    for _ in range(250):
        if execute(env, expert.command())["success"]:
            return
    pytest.fail("the can was not placed")


def test_fingers_over_the_square_rise_before_they_grasp_the_handle(envs):
    env = envs["NutAssemblySquare"]
    start(env, 8)
    expert = find_task("NutAssemblySquare").load_expert()(env.sim_env, style())
    nut = env.sim_env.nuts[env.sim_env.nut_id].root_body
    command = expert.command()
    while expert.hand().position[2] - expert.body(nut)[0][2] > 0.05:
        execute(env, command)
        command = expert.command()
    position, rotation = expert.body(nut)
    over_square = position + rotation @ [0.046, 0.0, 0.025]
    for _ in range(20):
        execute(env, np.array([*over_square, *command[3:6], -1.0]))
    hand = expert.hand().position
    np.testing.assert_allclose(hand, over_square, atol=0.004)
    assert expert.command()[2] > hand[2] + 0.005  # lower, they would come to rest on the square
    for _ in range(40):
        execute(env, expert.command())
        if expert.body(nut)[0][2] > position[2] + 0.03:
            return
    pytest.fail("the nut was not lifted by its handle")


@pytest.mark.parametrize("nut_yaw", np.linspace(-np.pi, np.pi, 25))
def test_square_grasp_holds_the_handle_across_and_stays_within_the_joint(nut_yaw):
    yaw = grasp_yaw(nut_yaw, 0.0)
    handle = np.array([np.cos(nut_yaw), np.sin(nut_yaw), 0.0])
    assert abs(downward(yaw)[:, 0] @ handle) < 1e-9
    assert -1.5 <= yaw <= 3.4
    assert grasp_yaw(nut_yaw + 0.1, yaw) == pytest.approx(yaw + 0.1)  # a choice is kept where it was close
    assert grasp_yaw(nut_yaw - 0.1, yaw) == pytest.approx(yaw - 0.1)


def test_yaw_is_measured_from_the_downward_hand():
    for yaw in (-3.0, -0.5, 0.0, 1.0, 3.0):
        assert Hand(np.zeros(3), downward(yaw), np.zeros(3), 0.08).yaw == pytest.approx(yaw)
    np.testing.assert_allclose(downward(0.0), DOWNWARD)


def test_nearest_equivalent_angle():
    assert nearest(0.1 + np.pi, 0.0, np.pi) == pytest.approx(0.1)
    assert nearest(-2.0, 2.0, np.pi / 2) == pytest.approx(-2.0 + 3 * np.pi / 2)
    assert abs(nearest(5.0, 1.0, 0.3) - 1.0) <= 0.15


def test_unknown_names_are_listed(envs):
    with refused("task"):
        find_task("Door").load_expert()
    with refused("quality"):
        draw_operator("human", np.random.default_rng(0))


def test_operators_differ_and_every_one_is_drawn():
    rng = np.random.default_rng(0)
    drawn = {draw_operator("mixed", rng).name for _ in range(100)}
    assert drawn == {operator.name for operator in OPERATORS["mixed"]}
    better, worse = OPERATORS["mixed"][0], OPERATORS["mixed"][-1]
    assert worse.reach[1] < better.reach[0]
    assert worse.noise > better.noise


# -- disturbance --------------------------------------------------------------------------------

CLEAN = np.array([0.1, 0.0, 0.9, np.pi, 0.0, 0.0, 1.0])


def disturbed(operator, steps=400, distance=0.1):
    disturb = Disturbance(operator, 1, np.random.default_rng(0))
    present = CLEAN[None, :3] - [[distance, 0.0, 0.0]]
    return np.stack([disturb(CLEAN, present) for _ in range(steps)])


def test_a_still_hand_executes_what_it_meant():
    np.testing.assert_allclose(disturbed(STILL), np.tile(CLEAN, (400, 1)), atol=1e-12)


def test_noise_has_its_size_far_away_and_shrinks_when_careful():
    noisy = replace(STILL, noise=0.01)
    far = disturbed(noisy)[:, :3] - CLEAN[:3]
    near = disturbed(noisy, distance=0.0)[:, :3] - CLEAN[:3]
    assert far.std() == pytest.approx(0.01, rel=0.25)
    assert near.std() < 0.3 * far.std()


def test_bump_pushes_once_and_never_down():
    pushed = disturbed(replace(STILL, bump=1.0))[:, :3] - CLEAN[:3]
    steps = np.flatnonzero(np.linalg.norm(pushed, axis=1) > 0.02)
    assert len(steps) == 4
    assert steps[-1] - steps[0] == 3
    assert (pushed[:, 2] >= 0).all()


def test_slip_opens_the_fingers_once():
    opened = np.flatnonzero(disturbed(replace(STILL, slip=1.0))[:, 6] < 0)
    assert len(opened) == 4
    assert opened[-1] - opened[0] == 3


def test_miss_closes_the_fingers_once_before_a_grasp_and_lifts_them_empty():
    approach = np.array([*CLEAN[:6], -1.0])
    disturb = Disturbance(replace(STILL, miss=1.0), 1, np.random.default_rng(0))
    distances = [0.1] * 5 + [0.02] * 40
    executed = np.stack([disturb(approach, approach[None, :3] - [[d, 0.0, 0.0]]) for d in distances])
    closed = np.flatnonzero(executed[:, 6] > 0)
    assert closed[0] == 5
    assert 6 <= len(closed) == closed[-1] - closed[0] + 1 < 18
    np.testing.assert_allclose(executed[closed[4:], 2], approach[2] + 0.04, atol=1e-9)
    np.testing.assert_allclose(
        np.delete(executed, closed, 0), np.tile(approach, (45 - len(closed), 1)), atol=1e-9
    )


def test_hesitation_stops_the_hand():
    paused = disturbed(replace(STILL, hesitation=0.1))[:, 0] < CLEAN[0]
    assert 0.1 < paused.mean() < 0.8


@pytest.mark.parametrize("place", [(0.18, -0.055), (0.2, 0.081)])
def test_a_can_that_was_dropped_beside_a_wall_is_grasped(envs, place):
    env = envs["PickPlaceCan"]
    start(env, 3)
    expert = find_task("PickPlaceCan").load_expert()(env.sim_env, style())
    can = env.sim_env.objects[env.sim_env.object_id]
    upright = [*place, 0.87, 1.0, 0.0, 0.0, 0.0]
    env.sim_env.sim.data.set_joint_qpos(can.joints[0], upright)
    for _ in range(250):
        td = execute(env, expert.command())
        if td["success"]:
            return
    pytest.fail(f"not solved, the can is at {expert.body(can.root_body)[0]}")
