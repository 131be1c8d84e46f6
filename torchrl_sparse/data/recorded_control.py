"""Task and controller for which a demonstration file's actions were recorded."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_sparse.data.controller_settings import (
    Choice,
    arm_settings,
    check_entries,
    check_env_kwargs,
    six_numbers,
)
from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import demo_group
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import POSE_DIM
from torchrl_sparse.storage.convention import Convention
from torchrl_sparse.storage.json import parse_json

__all__ = ["RecordedControl", "check_recorded_task", "read_control"]

_ENV_ARGS: dict[str, Choice] = {"env_name": None, "env_version": None, "type": (1,), "env_kwargs": None}
_RANGES = ("input_min", "input_max", "output_min", "output_max")


@dataclass(frozen=True)
class RecordedControl:
    """Task and controller of all demonstrations of a file, from its attribute ``env_args``.

    Attributes:
        env_name: robosuite's name of the task.
        are_deltas: actions are normalised deltas; False if they are absolute poses in the world's frame.
        frame: of deltas, "world" or "base", the robot's.
        input_min, input_max: range of a delta's position and rotation, six numbers; beyond it robosuite clips.
        output_min, output_max: what that range becomes, m and rad.
        keeps_orientation: a rotation of exactly zero leaves the goal's orientation as it was, as in robosuite up to 1.4;
            later versions make the hand's present orientation the goal.

    Examples:
        >>> control = RecordedControl("Lift")
        >>> control.clip(np.array([[0.5, 0, 0, 0, 0, 1.79, -1]]))
        (array([[ 0.5,  0. ,  0. ,  0. ,  0. ,  1. , -1. ]]), 1)
    """

    env_name: str
    are_deltas: bool = True
    frame: str = "world"
    input_min: tuple[float, ...] = (-1.0,) * 6
    input_max: tuple[float, ...] = (1.0,) * 6
    output_min: tuple[float, ...] = (-0.05,) * 3 + (-0.5,) * 3
    output_max: tuple[float, ...] = (0.05,) * 3 + (0.5,) * 3
    keeps_orientation: bool = False

    @property
    def convention(self) -> Convention:
        """Version of robosuite that defines the recorded object states."""
        return "1.4" if self.keeps_orientation else "1.5"

    def clip(self, actions: np.ndarray) -> tuple[np.ndarray, int]:
        """Return deltas [T, 7 * arms] clipped to the controller's input range, as in simulation, and the number clipped."""
        arms = actions.reshape(len(actions), -1, POSE_DIM)
        clipped = np.clip(arms, (*self.input_min, -1.0), (*self.input_max, 1.0))
        return clipped.reshape(actions.shape), int((clipped != arms).sum())


def check_recorded_task(file: Node, task: str | None, *, poses: bool) -> str:
    """Return the task that a file names for its demonstrations.

    Raises:
        InputError: unless it is ``task``, or any known one where that is None. Of a task whose actions are no ``poses``, whose
            environments take no options, the file may say nothing else.
    """
    args = _env_args(file)
    recorded = args["env_name"]
    if task is not None and recorded != task:
        raise InputError(f"{file.where}: expected demonstrations of {task}, got ones of {recorded}")
    if recorded not in TASKS:
        raise InputError(
            f"{file.where}, env_args.env_name: expected one of {', '.join(TASKS)}, got {recorded!r}"
        )
    if not poses:
        check_entries(f"{file.where}, env_args", args, _ENV_ARGS | {"type": None, "env_kwargs": ({},)})
    return recorded


def read_control(file: Node, *, poses: bool = False) -> RecordedControl:
    """Read the controller of an open demonstration file.

    Args:
        file: all of it.
        poses: its actions are absolute poses in the world's frame whatever controller it names, as of the files that Diffusion
            Policy (arXiv:2303.04137) publishes as ``*_abs.hdf5``.

    Raises:
        InputError: naming file and entry, if ``env_args`` are missing or damaged, or say anything but a known task of robosuite
            with Pandas under OSC_POSE as this library plays it.
    """
    args, where = _env_args(file), f"{file.where}, env_args"
    check_entries(where, args, _ENV_ARGS)
    task = TASKS.get(args["env_name"])
    if not isinstance(task, RobosuiteTask):
        known = ", ".join(name for name, task in TASKS.items() if isinstance(task, RobosuiteTask))
        raise InputError(
            f"{where}.env_name: expected a task of robosuite ({known}), got {args['env_name']!r}"
        )
    kwargs = args.get("env_kwargs", {})
    check_env_kwargs(f"{where}.env_kwargs", kwargs)
    robots = kwargs["robots"]
    if (robots if isinstance(robots, list) else [robots]) != ["Panda"] * task.arms:
        got = ", ".join(map(str, robots)) if isinstance(robots, list) else reprlib.repr(robots)
        raise InputError(f"{where}.env_kwargs.robots: expected {task.arms} times Panda, got {got}")
    configs = kwargs["controller_configs"]
    is_old = _is_old(f"{where}.env_version", args, configs)
    arm = arm_settings(f"{where}.env_kwargs.controller_configs", configs, is_old=is_old)
    return _control(f"{where}.env_kwargs.controller_configs", task.name, arm, is_old, poses)


def _control(where: str, task: str, arm: Mapping[str, Any], is_old: bool, poses: bool) -> RecordedControl:
    are_deltas = arm["input_type"] == "delta" and not poses
    if not are_deltas and not poses and arm["input_ref_frame"] != "world":
        raise InputError(
            f"{where}: expected absolute poses in the frame 'world', got ones in the frame of the robot's base"
        )
    ranges = {
        name: six_numbers(f"{where}.{name}", arm[name]) if name in arm else getattr(RecordedControl, name)
        for name in _RANGES
    }
    for low, high in (_RANGES[:2], _RANGES[2:]):
        if not all(a < b for a, b in zip(ranges[low], ranges[high], strict=True)):
            raise InputError(
                f"{where}.{low}: expected less than {high}, got {ranges[low]} and {ranges[high]}"
            )
    return RecordedControl(
        task,
        are_deltas=are_deltas,
        frame=arm["input_ref_frame"],
        **ranges,
        keeps_orientation=is_old,
    )


def _env_args(file: Node) -> dict[str, Any]:
    """Return what an open file says of how its demonstrations were made; its ``env_name`` is a text."""
    text = demo_group(file).text("env_args")
    if text is None:
        raise InputError(
            f"{file.where}: expected an attribute env_args of 'data', which says of which task and controller the "
            "demonstrations are, got none; robomimic and this library write it"
        )
    try:
        args = parse_json(text, dict[str, Any], "env_args")
    except ValueError as error:
        raise InputError(
            f"{file.where}, env_args: expected robomimic's description of an environment, got {reprlib.repr(text)}"
        ) from error
    if not isinstance(args.get("env_name"), str):
        raise InputError(
            f"{file.where}, env_args.env_name: expected the name of a task, got {reprlib.repr(args.get('env_name'))}"
        )
    return args


def _is_old(where: str, args: Mapping[str, Any], configs: Any) -> bool:
    """Tell whether robosuite 1.4 or earlier recorded; files without a version are of it if their controller is."""
    first = configs[0] if isinstance(configs, list) and configs else configs
    is_composite = isinstance(first, Mapping) and "body_parts" in first
    version = args.get("env_version")
    if version is None:
        return not is_composite
    numbers = re.match(r"1\.([2-5])(\.|$)", version) if isinstance(version, str) else None
    if numbers is None:
        raise InputError(f"{where}: expected robosuite 1.2 to 1.5, got {reprlib.repr(version)}")
    is_old = int(numbers[1]) < 5
    if is_old and is_composite:
        raise InputError(f"{where}: expected 1.5 with a composite controller, got {version!r}")
    return is_old
