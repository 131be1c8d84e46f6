"""Quiet import of robosuite, and construction of its simulators. Nothing here needs a GL library."""

from __future__ import annotations

import logging
import os
import sys
import threading
import types
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np

from torchrl_sparse.envs.models import compile_what_changes
from torchrl_sparse.envs.period.control import ControlPeriod
from torchrl_sparse.envs.tasks import RobosuiteTask

CONTROL_FREQ = 20
"""Actions a second of every robosuite environment here: 50 ms of physics pass between two of them."""

# One thread loads robots at a time: a method of their class is replaced meanwhile, and another would put back the replacement.
_LOADING = threading.Lock()


def import_robosuite() -> Any:
    """Import robosuite without its start-up warnings, even where no GL library is installed.

    Raises:
        ImportError: with the command that installs it.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")  # read by mujoco at import; only used if something is rendered
    quiet = logging.getLogger("robosuite_logs")
    quiet.addFilter(_only_errors)
    try:
        with cv2_or_stand_in():
            import robosuite
    except ImportError as error:
        raise ImportError(
            "robosuite environments need `pip install 'robosuite==1.5.2' 'mujoco<3.10'`"
        ) from error
    return robosuite


def make_simulator(
    task: RobosuiteTask,
    *,
    absolute: bool,
    reward_shaping: bool = False,
    control_freq: int = 20,
    compiled: bool = True,
) -> Any:
    """Make a state-only robosuite environment with Panda arms under OSC_POSE.

    Args:
        task: what to build.
        absolute: command world-frame poses (position, rotation vector, gripper) instead of normalised deltas.
        reward_shaping: robosuite's dense reward.
        control_freq: actions a second.
        compiled: False for robosuite's own substeps and models: the same bits, slower.
    """
    robosuite = import_robosuite()
    task.register()
    with _robots_uncompiled():
        sim_env = robosuite.make(
            task.name,
            robots=["Panda"] * task.arms,
            controller_configs=controller_config(absolute),
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            ignore_done=True,
            reward_shaping=reward_shaping,
            control_freq=control_freq,
        )
    if compiled:
        compile_what_changes(sim_env)
    _observe_when_asked(sim_env)
    _command_arms_alone(sim_env, compiled)
    return sim_env


@contextmanager
def _robots_uncompiled() -> Iterator[None]:
    """Spare the simulator a model of each robot on its own, which it compiles whenever it loads robots and never reads."""
    from robosuite.models.robots.robot_model import RobotModel

    with _LOADING, patch.object(RobotModel, "set_mujoco_model", lambda *_: None):
        yield


def _observe_when_asked(sim_env: Any) -> None:
    """Spare the simulator its observables in each of the 25 substeps of a step, of which only forced ones are read."""
    update = sim_env._update_observables

    def update_if_forced(force: bool = False) -> None:
        if force:
            update(force=True)

    sim_env._update_observables = update_if_forced


def _command_arms_alone(sim_env: Any, compiled: bool) -> None:
    """Spare the simulator, in all substeps of a step but the first, what its robots' control finds unchanged there.

    That is all but the torques of the arms: the gripper's command, where the base stands, how many numbers an action has. The
    torques and the physics are compiled where that is to the same bits, see `ControlPeriod`.
    """
    from robosuite.environments.robot_env import RobotEnv

    load, act = sim_env._load_robots, sim_env._pre_action
    period = ControlPeriod(sim_env) if compiled else None

    def load_robots() -> None:  # at each reset, but for one to a state that was saved
        with _robots_uncompiled():
            load()
        take_over()

    def take_over() -> None:
        for robot in sim_env.robots:
            robot.control = _arms_between_actions(robot, period)

    def pre_action(action: np.ndarray, policy_step: bool = False) -> None:
        if policy_step:
            return act(action, policy_step=True)
        for robot in sim_env.robots:
            robot.control(action)

    take_over()
    sim_env._load_robots = load_robots
    # A task in which something moves by itself has its own.
    if type(sim_env)._pre_action is RobotEnv._pre_action:
        sim_env._pre_action = pre_action
    if period is not None and period.exact:
        sim_env.step = period.step


def _arms_between_actions(robot: Any, period: ControlPeriod | None) -> Callable[..., None]:
    """Return the robot's ``control``, which goes on as it was told to where the action is not a new one.

    It does not keep the robot: with it each reset's simulator would stay in memory until Python looks for cycles.
    """
    follow = type(robot).control
    find: Callable[[], Any] = weakref.ref(robot)  # who calls it is there

    def control(action: np.ndarray, policy_step: bool = False) -> None:
        robot = find()
        if policy_step:
            return follow(robot, action, policy_step=True)
        if period is not None and period.control(robot):
            return
        for arm in robot.arms:
            controller = robot.part_controllers[arm]
            _look_once(controller)
            torques = controller.run_controller()
            actuators = robot._ref_actuators_indexes_dict[arm]
            limits = robot.sim.model.actuator_ctrlrange[actuators]
            robot.sim.data.ctrl[actuators] = np.clip(torques, limits[:, 0], limits[:, 1])

    return control


def _look_once(controller: Any) -> None:
    """Do what the controller's ``update`` does, with both of its site's Jacobians from one call instead of each from two."""
    if not (controller.new_update and controller.lite_physics and controller.num_ref_sites == 1):
        return  # it looks itself
    import mujoco  # reads MUJOCO_GL

    sim, joints = controller.sim, controller.qvel_index
    model, data = sim.model._model, sim.data._data
    site = sim.model.site_name2id(controller.ref_name)
    jacobians = np.zeros((2, 3, model.nv))
    mujoco.mj_jacSite(model, data, *jacobians, site)
    controller.ref_pos[:] = data.site_xpos[site]
    controller.ref_ori_mat[:] = data.site_xmat[site].reshape(3, 3)
    controller.ref_pos_vel[:], controller.ref_ori_vel[:] = (each.dot(data.qvel) for each in jacobians)
    controller.J_pos[:], controller.J_ori[:] = jacobians[:, :, joints]
    controller.J_full[:3], controller.J_full[3:] = controller.J_pos, controller.J_ori
    controller.joint_pos = np.array(data.qpos[controller.qpos_index])
    controller.joint_vel = np.array(data.qvel[joints])
    inertia = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, inertia, data.qM)
    controller.mass_matrix = inertia[joints, :][:, joints]
    controller.new_update = False


def site_twist(sim: Any, name: str) -> np.ndarray:
    """Return f64 [6], the velocity of a site as robosuite has it: m/s, then rad/s, world frame."""
    import mujoco  # reads MUJOCO_GL

    model, data = sim.model._model, sim.data._data
    jacobians = np.zeros((2, 3, model.nv))
    mujoco.mj_jacSite(model, data, *jacobians, sim.model.site_name2id(name))
    return np.concatenate([each.dot(data.qvel) for each in jacobians])


def controller_config(absolute: bool) -> dict:
    """Build one Panda's composite controller config, as robosuite takes it and demonstration files record it."""
    from robosuite.controllers import load_composite_controller_config

    config = load_composite_controller_config(controller="BASIC")
    arm = config["body_parts"]["right"]
    if absolute:
        arm.update(input_type="absolute", input_ref_frame="world")
    config["body_parts"] = {"right": arm}
    return config


def _only_errors(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR


@contextmanager
def cv2_or_stand_in() -> Iterator[None]:
    """Let simulators import a stand-in for cv2 where libGL is missing.

    Simulators use cv2 only to draw on a screen, which nothing here does. The stand-in is gone when the block ends.
    """
    try:
        import cv2  # noqa: F401
    except ImportError:
        stand_in = sys.modules["cv2"] = types.ModuleType("cv2")
        try:
            yield
        finally:
            if sys.modules.get("cv2") is stand_in:
                del sys.modules["cv2"]
    else:
        yield
