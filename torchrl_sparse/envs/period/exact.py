"""Telling where the compiled substeps are robosuite's own, to the last bit: only what was compared is taken."""

from __future__ import annotations

from typing import Any

from torchrl_sparse.envs.period.library import functions, library

__all__ = ["why_not", "why_not_arms"]

_ROBOSUITE = "1.5.2"
_MOST_JOINTS = 8


def why_not(sim_env: Any) -> str | None:
    """Return why this environment steps as robosuite has it, None if the compiled substeps may take its place."""
    import robosuite
    from robosuite import macros
    from robosuite.environments.base import MujocoEnv

    for missing in (library(), functions()):
        if isinstance(missing, str):
            return missing
    if robosuite.__version__ != _ROBOSUITE:
        return f"robosuite is {robosuite.__version__}, not {_ROBOSUITE}"
    if not macros.ENABLE_NUMBA:
        return "robosuite's numba is off"
    if type(sim_env).step is not MujocoEnv.step:
        return f"{type(sim_env).__name__} has a step of its own"
    if not sim_env.lite_physics:
        return "lite_physics is off"
    if sim_env.viewer is not None or sim_env.has_renderer:
        return "a viewer is open"
    return None


def why_not_arms(sim_env: Any) -> str | None:
    """Return why the robots that it has now are not controlled by the compiled substeps."""
    from robosuite.robots.fixed_base_robot import FixedBaseRobot

    for robot in sim_env.robots:
        if type(robot) is not FixedBaseRobot:
            return f"{type(robot).__name__} has no fixed base"
        if (reason := _why_not_controller(robot)) is not None:
            return reason
    return None


def _why_not_controller(robot: Any) -> str | None:
    from robosuite.controllers.composite.composite_controller import CompositeController
    from robosuite.controllers.parts.arm.osc import OperationalSpaceController
    from robosuite.controllers.parts.gripper.simple_grip import SimpleGripController
    from robosuite.models.grippers import PandaGripper

    composite, parts = robot.composite_controller, robot.part_controllers
    grippers = {robot.get_gripper_name(arm) for arm in robot.arms}
    if type(composite) is not CompositeController or set(parts) != {*robot.arms, *grippers}:
        return f"{type(composite).__name__} of {', '.join(parts)} is another controller"
    for name, part in parts.items():
        if type(part) is not (SimpleGripController if name in grippers else OperationalSpaceController):
            return f"{type(part).__name__} is another controller"
        if name in grippers:
            if part.interpolator is not None or type(composite.grippers[name]) is not PandaGripper:
                return f"{type(composite.grippers[name]).__name__} is another gripper, or an interpolated one"
        elif not _is_plain(part):
            return "OSC_POSE has other settings: interpolated, of variable impedance or coupled"
    return None


def _is_plain(arm: Any) -> bool:
    model = arm.sim.model._model
    base = arm.sim.model.site_name2id(f"{arm.naming_prefix}{arm.part_name}_center")
    return (
        arm.interpolator_pos is None
        and arm.interpolator_ori is None
        and arm.impedance_mode == "fixed"
        and arm.uncoupling
        and arm.use_ori
        and arm.num_ref_sites == 1
        and arm.lite_physics
        and len(arm.qvel_index) <= _MOST_JOINTS
        and model.body_weldid[model.site_bodyid[base]] == 0  # a base that moves has a velocity
    )
