"""Importing robosuite quietly, and making its simulators. Nothing here needs a GL library."""

from __future__ import annotations

import logging
import os
import sys
import types
from typing import Any

from torchrl_sparse.envs.tasks import Task


def import_robosuite():
    """robosuite, without its start-up warnings, and also where no GL library is installed.

    Raises:
        ImportError: with the command that installs it.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")  # read by mujoco at import; only used if something is rendered
    quiet = logging.getLogger("robosuite_logs")
    quiet.addFilter(_only_errors)
    stand_in_for_missing_cv2()
    try:
        import robosuite
    except ImportError as error:
        raise ImportError(
            "robosuite environments need `pip install 'robosuite==1.5.2' 'mujoco<3.10'`"
        ) from error
    return robosuite


def make_simulator(
    task: Task, *, absolute: bool, reward_shaping: bool = False, control_freq: int = 20
) -> Any:
    """A state-only robosuite environment of Pandas under OSC_POSE.

    Args:
        task: what to build.
        absolute: command world-frame poses (position, rotation vector, gripper) instead of normalised deltas.
        reward_shaping: robosuite's dense reward.
        control_freq: actions a second.
    """
    robosuite = import_robosuite()
    from torchrl_sparse.envs import moving_lift, named_lift  # noqa: F401  (they register their tasks)

    return robosuite.make(
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


def controller_config(absolute: bool) -> dict:
    """The composite controller of one Panda, as robosuite takes it and as demonstration files record it."""
    from robosuite.controllers import load_composite_controller_config

    config = load_composite_controller_config(controller="BASIC")
    arm = config["body_parts"]["right"]
    if absolute:
        arm.update(input_type="absolute", input_ref_frame="world")
    config["body_parts"] = {"right": arm}
    return config


def _only_errors(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR


def stand_in_for_missing_cv2() -> None:
    """Simulators import cv2 for what is drawn on a screen, and cv2 cannot be imported without libGL."""
    try:
        import cv2  # noqa: F401
    except ImportError:
        sys.modules["cv2"] = types.ModuleType("cv2")
