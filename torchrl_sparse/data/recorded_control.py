"""The controller that a demonstration file's actions were meant for."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_sparse.data.hdf5_bounds import text_attribute
from torchrl_sparse.envs.tasks import TASKS
from torchrl_sparse.rotations import POSE_DIM
from torchrl_sparse.storage.json import parse_json

__all__ = ["RecordedControl", "check_recorded_task", "read_control"]


@dataclass(frozen=True)
class RecordedControl:
    """Task and controller of a demonstration file, as its attribute ``env_args`` tells them.

    Attributes:
        env_name: robosuite's name of the task.
        robots: names of the robots.
        arm: settings of each arm's controller, in the terms of robosuite 1.5.
        keeps_orientation: a rotation of exactly zero leaves the goal's orientation as it was, as in robosuite up to 1.4;
            later versions make the hand's present orientation the goal.

    Examples:
        >>> control = RecordedControl("Lift", ("Panda",), {"input_type": "delta"}, keeps_orientation=False)
        >>> control.are_deltas(np.zeros((1, 7))), control.are_deltas(np.full((1, 7), 2.2))
        (True, False)
    """

    env_name: str
    robots: tuple[str, ...]
    arm: Mapping[str, Any]
    keeps_orientation: bool

    def are_deltas(self, actions: np.ndarray) -> bool:
        """Tell whether actions [T, 7 * arms] are normalised deltas rather than absolute poses.

        Diffusion Policy's published ``*_abs.hdf5`` files hold poses and still describe a delta controller. The rotation
        vector of a gripper that points down is about pi long, which no normalised delta is.
        """
        rotation = actions.reshape(len(actions), -1, POSE_DIM)[..., 3:6]
        return self.arm.get("input_type", "delta") == "delta" and bool(np.abs(rotation).max() <= 1)


def check_recorded_task(path: Path, file: h5py.File, task: str) -> None:
    """Raise ValueError, naming both, if the file says that its demonstrations are of another task here."""
    text = text_attribute(str(path), file["data"], "env_args")
    try:
        recorded = json.loads(text or "{}").get("env_name")
    except (ValueError, AttributeError, RecursionError):
        return  # what is wrong with it, `read_control` says where it is needed
    if isinstance(recorded, str) and recorded != task and recorded in TASKS:
        raise ValueError(f"{path}: expected demonstrations of {task}, got ones of {recorded}")


def read_control(path: str | Path, file: h5py.File) -> RecordedControl | None:
    """Read the controller of an open demonstration file; None if it names none.

    Raises:
        ValueError: naming the file, if ``env_args`` are damaged or describe anything but one OSC_POSE controller.
    """
    text = text_attribute(str(path), file["data"], "env_args")
    if text is None:
        return None
    try:
        env_args = parse_json(text, dict[str, Any], "env_args")
        kwargs = env_args["env_kwargs"]
        config, robots = kwargs["controller_configs"], kwargs["robots"]
        arm, is_old = _arm_settings(config)
        robots = (robots,) if isinstance(robots, str) else tuple(robots)
        return RecordedControl(str(env_args["env_name"]), robots, arm, keeps_orientation=is_old)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}, env_args: expected robomimic's description of a robosuite task under OSC_POSE, "
            f"got {reprlib.repr(text)} ({error})"
        ) from error


def _arm_settings(config: Mapping[str, Any] | list) -> tuple[Mapping[str, Any], bool]:
    """Return the settings of one arm in robosuite 1.5's terms, and whether they were written by 1.4 or earlier."""
    configs = config if isinstance(config, list) else [config]
    if any(other != configs[0] for other in configs):
        raise ValueError("arms with different controllers")
    config = configs[0]
    is_old = "body_parts" not in config
    if is_old:  # goals were in the world frame then
        kind = "delta" if config.get("control_delta", True) else "absolute"
        arm = {**config, "input_type": kind, "input_ref_frame": "world"}
    else:
        parts = config["body_parts"]
        arm = parts.get("arms", parts)["right"]
    if arm["type"] != "OSC_POSE" or arm.get("impedance_mode", "fixed") != "fixed":
        raise ValueError(f"a controller {arm['type']}, impedance {arm.get('impedance_mode', 'fixed')}")
    if arm.get("input_type") == "absolute" and arm.get("input_ref_frame") != "world":
        raise ValueError("absolute poses in the frame of the robot's base")
    return arm, is_old
