"""What robosuite's ``object-state`` meant up to version 1.4, and which meaning a policy was trained on.

Up to 1.4 the parts of the objects' state came in another order, those of an object before those between it and the hand, and
Lift's ``gripper_to_cube_pos`` was the hand's position minus the cube's, of which 1.5 has the opposite. All other numbers
of one and the same state are equal in both. Published checkpoints were trained before 1.5.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np

__all__ = ["Convention", "check_convention", "object_state", "source_convention"]

Convention = Literal["1.5", "1.4"]
"""The last version of robosuite whose meaning the observations have."""


def _posed(thing: str) -> tuple[str, ...]:
    return tuple(f"{thing}{part}" for part in ("_pos", "_quat", "_to_robot0_eef_pos", "_to_robot0_eef_quat"))


_PARTS = {
    "Lift": ("cube_pos", "cube_quat", "gripper_to_cube_pos"),
    "PickPlaceCan": _posed("Can"),
    "NutAssemblySquare": _posed("SquareNut"),
    "ToolHang": (*_posed("base"), *_posed("frame"), *_posed("tool"), "frame_is_assembled", "tool_on_frame"),
    "TwoArmTransport": (
        *("payload_pos", "payload_quat", "trash_pos", "trash_quat", "lid_handle_pos", "lid_handle_quat"),
        *("target_bin_pos", "trash_bin_pos", "gripper0_to_payload", "gripper0_to_lid_handle"),
        *("gripper1_to_payload", "gripper1_to_trash", "payload_in_target_bin", "trash_in_trash_bin"),
    ),
}
_NEGATED = ("gripper_to_cube_pos",)


def check_convention(convention: str, task: str) -> None:
    """Raise ValueError unless observations of the robosuite task can be had in that convention."""
    known = get_args(Convention) if task in _PARTS else ("1.5",)
    if convention not in known:
        raise ValueError(f"convention: expected {' or '.join(known)} for {task}, got {convention!r}")


def object_state(task: str, observed: Mapping[str, Any], convention: Convention) -> np.ndarray:
    """Return f64 [object_dim], the objects' state as that version of robosuite observed it.

    Args:
        task: robosuite's name of it.
        observed: robosuite 1.5's observations by name.
        convention: see `Convention`.

    >>> seen = {"cube_pos": [1.0, 2, 3], "cube_quat": [0, 0, 0, 1], "gripper_to_cube_pos": [0.1, 0.2, 0.3]}
    >>> object_state("Lift", seen, "1.4")[-3:]
    array([-0.1, -0.2, -0.3])
    """
    if convention == "1.5":
        return np.asarray(observed["object-state"])
    signed = [np.atleast_1d(observed[name]) * (-1.0 if name in _NEGATED else 1.0) for name in _PARTS[task]]
    return np.concatenate(signed)


def source_convention(source: Mapping[str, Any]) -> Convention:
    """Return the convention of a policy's ``source``, see `torchrl_sparse.storage.diffusion.StoredPolicy`.

    Policies that were trained here have the present one. An imported one has that of its ``"robosuite"``, a version; without
    it, that of robosuite 1.2, which the published code installs.

    >>> source_convention({}), source_convention({"weights": "ema_model", "robosuite": "1.4.1"})
    ('1.5', '1.4')
    """
    version = source.get("robosuite") or ("1.2" if "weights" in source else "1.5")
    numbers = re.match(r"(\d+)\.(\d+)", version)
    if numbers is None:
        raise ValueError(f"policy.source['robosuite']: expected a version such as 1.4.1, got {version!r}")
    return "1.4" if tuple(map(int, numbers.groups())) < (1, 5) else "1.5"
