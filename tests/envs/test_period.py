"""Compiled substeps against robosuite's own step: whole states, what controllers saw, rewards and counters, bit for bit."""

import logging

import numpy as np
import pytest

from torchrl_sparse.envs.period import control, exact
from torchrl_sparse.envs.period.control import ControlPeriod
from torchrl_sparse.envs.period.library import library
from torchrl_sparse.envs.simulator import controller_config, import_robosuite, make_simulator
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask, find_robosuite_task

pytestmark = pytest.mark.skipif(isinstance(library(), str), reason=str(library()))

ROBOSUITE = [task.name for task in TASKS.values() if isinstance(task, RobosuiteTask)]
SEEN = ("ref_pos", "ref_ori_mat", "ref_pos_vel", "ref_ori_vel", "J_full", "J_pos", "J_ori", "mass_matrix")
KEPT = ("joint_pos", "joint_vel", "torques", "goal_pos", "goal_ori", "initial_joint")
STATE = ("qpos", "qvel", "qacc", "qacc_warmstart", "act", "ctrl", "xfrc_applied", "site_xpos")


@pytest.fixture(autouse=True)
def told_anew():
    control._tell.cache_clear()


def plain(task, absolute):
    """robosuite's environment as it makes it, with nothing of ours."""
    task.register()
    return import_robosuite().make(
        task.name,
        robots=["Panda"] * task.arms,
        controller_configs=controller_config(absolute),
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        ignore_done=True,
    )


def start(sim_env, seed):
    sim_env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
    sim_env.reset()


def command(sim_env, rng, absolute):
    parts = []
    for robot in sim_env.robots:
        site = robot.gripper["right"].important_sites["grip_site"]
        pose = sim_env.sim.data.get_site_xpos(site) + rng.uniform(-0.05, 0.05, 3)
        turned = np.array([np.pi, 0.0, 0.0]) + rng.uniform(-0.3, 0.3, 3)
        arm = np.concatenate([pose, turned]) if absolute else rng.uniform(-1, 1, 6)
        parts += [arm, rng.uniform(-1, 1, 1)]
    return np.concatenate(parts)


def assert_same(fast, own):
    for name in STATE:
        assert np.array_equal(getattr(fast.sim.data, name), getattr(own.sim.data, name)), name
    assert (fast.sim.data.time, fast.cur_time, fast.timestep) == (
        own.sim.data.time,
        own.cur_time,
        own.timestep,
    )
    assert fast._check_success() == own._check_success()
    for robot, other in zip(fast.robots, own.robots, strict=True):
        ours, theirs = robot.part_controllers["right"], other.part_controllers["right"]
        for name in (*SEEN, *KEPT):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
        assert np.array_equal(robot.recent_ee_acc["right"].current, other.recent_ee_acc["right"].current)


def assert_steps_alike(name, absolute, *, steps, episodes):
    task = find_robosuite_task(name)
    fast, own = make_simulator(task, absolute=absolute), plain(task, absolute)
    rng = np.random.default_rng(0)
    for seed in range(episodes):
        start(fast, seed)
        start(own, seed)
        for _ in range(steps):
            action = command(own, rng, absolute)
            assert fast.step(action)[1:3] == own.step(action)[1:3]
            assert_same(fast, own)
    assert fast.step.__self__.exact


@pytest.mark.parametrize(
    ("name", "absolute"),
    [
        ("Lift", True),
        ("Lift", False),
        ("LiftMoving", True),
        ("LiftTwoWays", False),
        ("TwoArmTransport", False),
    ],
)
def test_a_step_is_robosuites_own_to_the_last_bit(name, absolute):
    assert_steps_alike(name, absolute, steps=8, episodes=2)


@pytest.mark.full
@pytest.mark.parametrize("absolute", [True, False])
@pytest.mark.parametrize("name", ROBOSUITE)
def test_whole_episodes_of_every_task_are_robosuites_own(name, absolute):
    assert_steps_alike(name, absolute, steps=60, episodes=2)


@pytest.fixture
def lift():
    sim_env = make_simulator(find_robosuite_task("Lift"), absolute=False)
    start(sim_env, 3)
    return sim_env


def test_settings_changed_between_steps_are_followed(lift):
    own = plain(find_robosuite_task("Lift"), False)
    start(own, 3)
    rng = np.random.default_rng(1)
    for number in range(6):
        action = command(own, rng, False)
        for sim_env in (lift, own):
            controller = sim_env.robots[0].part_controllers["right"]
            if number == 2:
                controller.kp = controller.kp * 1.5
            if number == 4:
                controller.update_initial_joints(controller.initial_joint + 0.1)
            sim_env.step(action)
        assert_same(lift, own)


@pytest.fixture(autouse=True)
def _logs(monkeypatch, caplog):
    """Whatever Hydra has switched off in this process."""
    monkeypatch.setattr(control._log, "disabled", False)
    monkeypatch.setattr(control._log, "propagate", True)
    caplog.set_level(logging.WARNING)


def told(caplog):
    return [record.getMessage() for record in caplog.records if record.name == control.__name__]


def steps_as_robosuite(sim_env):
    own = plain(find_robosuite_task("Lift"), False)
    rng = np.random.default_rng(2)
    for each in (sim_env, own):
        start(each, 5)
    for _ in range(3):
        action = command(own, rng, False)
        assert sim_env.step(action)[1] == own.step(action)[1]
        assert_same(sim_env, own)


@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (lambda patch: patch.setattr(exact, "library", lambda: "it was not built"), "it was not built"),
        (lambda patch: patch.setattr(exact, "_ROBOSUITE", "1.6.0"), "robosuite is 1.5.2, not 1.6.0"),
        (lambda patch: patch.setattr(exact, "functions", lambda: "no mj_step1"), "no mj_step1"),
        (lambda patch: patch.setattr(exact, "_MOST_JOINTS", 6), "OSC_POSE has other settings"),
    ],
)
def test_where_it_is_not_known_to_be_exact_robosuites_own_step_is_taken_and_one_line_says_why(
    break_it, reason, caplog, monkeypatch
):
    break_it(monkeypatch)
    with caplog.at_level(logging.WARNING):
        steps_as_robosuite(make_simulator(find_robosuite_task("Lift"), absolute=False))
    (line,) = told(caplog)
    assert reason in line


def test_a_simulator_with_a_step_of_its_own_keeps_it(lift, caplog):
    class Own(type(lift)):
        def step(self, action):
            return "own"

    lift.__class__ = Own
    assert not ControlPeriod(lift).exact
    assert told(caplog) == [
        "robosuite steps in Python, slower and to the same bits: Own has a step of its own"
    ]


def test_torques_that_differ_in_one_bit_are_not_taken(caplog, monkeypatch):
    take = ControlPeriod._command

    def off_by_one_bit(period, number):
        done = take(period, number)
        period._arms[number].torques[0] = np.nextafter(period._arms[number].torques[0], np.inf)
        return done

    monkeypatch.setattr(ControlPeriod, "_command", off_by_one_bit)
    steps_as_robosuite(make_simulator(find_robosuite_task("Lift"), absolute=False))
    (line,) = told(caplog)
    assert "its torques are others here" in line


def test_what_robosuite_raises_is_raised(lift):
    lift.step(np.zeros(7))
    lift.robots[0].part_controllers["right"].initial_joint[:] = 0.0
    lift.sim.model._model.dof_armature[:] = np.nan  # no mass matrix to invert
    with pytest.raises(np.linalg.LinAlgError, match="infs or NaNs"):
        lift.step(np.zeros(7))
