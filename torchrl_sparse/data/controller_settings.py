"""Checks of a demonstration file's robot and controller settings, entry by entry.

An entry is honoured, has the value that gives steps and actions their meaning in this library's environments, or cannot change
that meaning. Any other is refused by its name. Entries are those of robosuite 1.2 to 1.5, in the form in which robomimic
(arXiv:2108.03298) keeps them: up to 1.4 one flat dictionary, from 1.5 on a composite controller's ``body_parts``.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Collection, Mapping
from typing import Any

from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.errors import InputError

__all__ = ["Choice", "arm_settings", "check_entries", "check_env_kwargs", "six_numbers"]

Choice = Collection[Any] | None
"""The values that an entry may have; None where it is read elsewhere or no value changes what an action or a step means."""

_ENV_KWARGS: dict[str, Choice] = {
    "robots": None,
    "controller_configs": None,
    "control_freq": (CONTROL_FREQ,),
    "env_configuration": (None, "default", "opposed", "single-arm-opposed"),
    "gripper_types": (None, "default", "PandaGripper"),
    "mount_types": (None, "default", "RethinkMount"),
    "base_types": (None, "default", "RethinkMount"),
    # What is seen or drawn, how episodes begin, end and are rewarded, and how often physics looks again within a step.
    **dict.fromkeys(
        (
            *("has_renderer", "has_offscreen_renderer", "render_camera", "render_gpu_device_id", "renderer"),
            *(
                "renderer_config",
                "render_collision_mesh",
                "render_visual_mesh",
                "use_camera_obs",
                "camera_names",
            ),
            *("camera_heights", "camera_widths", "camera_depths", "camera_segmentations", "use_object_obs"),
            *(
                "reward_shaping",
                "reward_scale",
                "ignore_done",
                "horizon",
                "hard_reset",
                "initialization_noise",
            ),
            *("placement_initializer", "seed", "lite_physics"),
        )
    ),
}

_SIX_150 = (150, [150] * 6)
_ONE = (1, [1] * 6)
_ARM: dict[str, Choice] = {
    "type": ("OSC_POSE",),
    **dict.fromkeys(("input_max", "input_min", "output_max", "output_min")),
    "kp": _SIX_150,
    "damping": _ONE,
    "damping_ratio": _ONE,
    "impedance_mode": ("fixed",),
    "position_limits": (None,),
    "orientation_limits": (None,),
    "uncouple_pos_ori": (True,),
    "control_ori": (True,),
    "interpolation": (None,),
    "policy_freq": (CONTROL_FREQ,),
    # Of impedances that vary and of interpolations, which are refused.
    **dict.fromkeys(("kp_limits", "damping_limits", "damping_ratio_limits", "ramp_ratio")),
}
_ARM_14: dict[str, Choice] = _ARM | {"control_delta": (True, False)}
_ARM_15: dict[str, Choice] = _ARM | {
    "control_delta": (True, False),  # not read by 1.5, which published files of 1.5 still have
    "input_type": ("delta", "absolute"),
    "input_ref_frame": ("world", "base"),
    "goal_update_mode": ("achieved",),
    "lite_physics": (True, False),
    "gripper": ({"type": "GRIP"},),
}
_COMPOSITE: dict[str, Choice] = {
    "type": ("BASIC",),
    "body_parts": None,
    "composite_controller_specific_configs": (None, {}),
}
# Parts that a Panda on a table does not have: robosuite drops them.
_BODY_PARTS: dict[str, Choice] = dict.fromkeys(
    ("right", "left", "arms", "torso", "head", "base", "legs", "left_gripper", "right_gripper")
)


def check_entries(where: str, entries: Any, known: Mapping[str, Choice]) -> None:
    """Raise InputError, starting with ``where``, for an unknown entry or an unsupported value.

    >>> check_entries("env_kwargs", {"control_freq": 10}, {"control_freq": (20,)})
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: env_kwargs.control_freq: expected 20, got 10
    """
    if not isinstance(entries, Mapping):
        raise InputError(f"{where}: expected entries by name, got {reprlib.repr(entries)}")
    for name, value in entries.items():
        if name not in known:
            raise InputError(
                f"{where}.{name}: expected one of {', '.join(known)}, got an entry of which is not known what it changes"
            )
        choice = known[name]
        if choice is not None and not any(value == each and _kind(value) == _kind(each) for each in choice):
            raise InputError(
                f"{where}.{name}: expected {' or '.join(map(repr, choice))}, got {reprlib.repr(value)}"
            )


def check_env_kwargs(where: str, env_kwargs: Any) -> None:
    """Raise InputError for an entry that would give actions or steps another meaning than in this library."""
    check_entries(where, env_kwargs, _ENV_KWARGS)
    for name in ("robots", "controller_configs"):
        if name not in env_kwargs:
            raise InputError(f"{where}.{name}: expected it, got {sorted(env_kwargs)[:20]}")


def arm_settings(where: str, configs: Any, *, is_old: bool) -> dict[str, Any]:
    """Return the settings of each arm's controller in robosuite 1.5 terms.

    Args:
        where: of ``configs``, for messages.
        configs: one, or one for each robot; all the same.
        is_old: they were written by robosuite 1.4 or earlier.

    Raises:
        InputError: naming the entry, if arms differ, or it is any other controller than OSC_POSE of this library's gains.
    """
    each = configs if isinstance(configs, list) and configs else [configs]
    if any(other != each[0] for other in each):
        raise InputError(f"{where}: expected the same controller for all arms, got different ones")
    if is_old or (isinstance(each[0], Mapping) and "body_parts" not in each[0]):
        return _flat_settings(where, each[0], is_old)
    check_entries(where, each[0], _COMPOSITE)
    parts = each[0]["body_parts"]
    check_entries(f"{where}.body_parts", parts, _BODY_PARTS)
    where, arms = (
        (f"{where}.body_parts.arms", parts["arms"]) if "arms" in parts else (f"{where}.body_parts", parts)
    )
    check_entries(where, arms, _BODY_PARTS)
    if "right" not in arms:
        raise InputError(f"{where}: expected an arm 'right', got {sorted(arms)[:5]}")
    return _new_settings(f"{where}.right", arms["right"])


def six_numbers(where: str, value: Any) -> tuple[float, ...]:
    """Return six numbers, from a list of six or from one number for all."""
    values = value if isinstance(value, list) else [value] * 6
    is_number = all(isinstance(each, (int, float)) and not isinstance(each, bool) for each in values)
    if len(values) != 6 or not is_number or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: expected a number or six, got {reprlib.repr(value)}")
    return tuple(map(float, values))


def _flat_settings(where: str, config: Any, is_old: bool) -> dict[str, Any]:
    if not is_old:  # robosuite 1.5 takes one and completes it with its own defaults
        return _new_settings(where, config)
    check_entries(where, config, _ARM_14)
    _check_type(where, config)
    kind = "delta" if config.get("control_delta", True) else "absolute"
    return {**config, "input_type": kind, "input_ref_frame": "world"}  # goals were in the world frame then


def _new_settings(where: str, config: Any) -> dict[str, Any]:
    check_entries(where, config, _ARM_15)
    _check_type(where, config)
    if config.get("control_delta") is False and config.get("input_type") != "absolute":
        raise InputError(
            f"{where}.control_delta: expected true or input_type 'absolute' with it, got false, which 1.5 does not read"
        )
    return {"input_type": "delta", "input_ref_frame": "base", **config}


def _check_type(where: str, config: Mapping[str, Any]) -> None:
    if "type" not in config:
        raise InputError(f"{where}.type: expected OSC_POSE, got none")


def _kind(value: Any) -> type:
    """Return the type of a value, one for all numbers: 20.0 is 20, and True is not 1."""
    return float if isinstance(value, (int, float)) and not isinstance(value, bool) else type(value)
