"""The meaning of robosuite's ``object-state`` up to version 1.4 and since, and conversions between them.

Up to 1.4 the parts of the objects' state came in another order, those of an object before those between it and the hand, and
Lift's ``gripper_to_cube_pos`` was the hand's position minus the cube's, of which 1.5 has the opposite. All other numbers
of one and the same state are equal in both. Published checkpoints were trained before 1.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.convention import Convention

__all__ = ["check_convention", "object_state", "translate_objects"]

_OWN, _RELATIVE = ("_pos", "_quat"), ("_to_robot0_eef_pos", "_to_robot0_eef_quat")


def _posed(things: Sequence[str], *groups: Sequence[str]) -> tuple[str, ...]:
    return tuple(thing + part for thing in things for group in groups for part in group)


_LIFT = ("cube_pos", "cube_quat", "gripper_to_cube_pos")
_TOOLS, _HUNG = ("base", "frame", "tool"), ("frame_is_assembled", "tool_on_frame")
_PLACED = (
    *("payload_pos", "payload_quat", "trash_pos", "trash_quat", "lid_handle_pos", "lid_handle_quat"),
    *("target_bin_pos", "trash_bin_pos"),
)
_REACHED = ("gripper0_to_payload", "gripper0_to_lid_handle", "gripper1_to_payload", "gripper1_to_trash")
_IN_BINS = ("payload_in_target_bin", "trash_in_trash_bin")
_PARTS: dict[str, dict[Convention, tuple[str, ...]]] = {
    "Lift": {"1.4": _LIFT, "1.5": _LIFT},
    "PickPlaceCan": {"1.4": _posed(["Can"], _OWN, _RELATIVE), "1.5": _posed(["Can"], _RELATIVE, _OWN)},
    "NutAssemblySquare": {
        "1.4": _posed(["SquareNut"], _OWN, _RELATIVE),
        "1.5": _posed(["SquareNut"], _RELATIVE, _OWN),
    },
    "ToolHang": {
        "1.4": (*_posed(_TOOLS, _OWN, _RELATIVE), *_HUNG),
        "1.5": (*_posed(_TOOLS, _RELATIVE, _OWN), *_HUNG),
    },
    "TwoArmTransport": {"1.4": (*_PLACED, *_REACHED, *_IN_BINS), "1.5": (*_PLACED, *_IN_BINS, *_REACHED)},
}
_NEGATED = ("gripper_to_cube_pos",)


def check_convention(convention: str, task: str) -> None:
    """Raise InputError unless the task's observations exist in that convention."""
    known = get_args(Convention) if task in _PARTS else ("1.5",)
    if convention not in known:
        raise InputError(f"convention: expected {' or '.join(known)} for {task}, got {convention!r}")


def object_state(task: str, observed: Mapping[str, Any], convention: Convention) -> np.ndarray:
    """Return the objects' state, f64 [object_dim], in that robosuite version's convention.

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
    signed = [np.atleast_1d(observed[name]) * _sign(name) for name in _PARTS[task]["1.4"]]
    return np.concatenate(signed)


def translate_objects(
    task: str, state: np.ndarray, *, observed: Convention, wanted: Convention
) -> np.ndarray:
    """Convert the objects' state [..., object_dim] from one convention to another.

    Args:
        task: robosuite's name of it.
        state: as ``observed`` has it.
        observed, wanted: see `Convention`.

    Raises:
        InputError: if the task is not known in both, or the state is of another size than the task's.

    >>> translate_objects("Lift", np.arange(10.0), observed="1.4", wanted="1.5")[-3:]
    array([-7., -8., -9.])
    """
    if observed == wanted:
        return state
    for convention in (observed, wanted):
        check_convention(convention, task)
    places, end = {}, 0
    for name in _PARTS[task][observed]:
        places[name] = range(end, end := end + _size(name))
    if state.shape[-1] != end:
        raise InputError(f"object: expected {end} numbers for {task}, got {state.shape[-1]}")
    order = [place for name in _PARTS[task][wanted] for place in places[name]]
    signs = np.concatenate([np.full(_size(name), _sign(name)) for name in _PARTS[task][wanted]])
    return state[..., order] * signs.astype(state.dtype)


def _size(part: str) -> int:
    if part in (*_HUNG, *_IN_BINS):
        return 1
    return 4 if part.endswith("_quat") else 3


def _sign(part: str) -> float:
    """Return the sign between the two conventions."""
    return -1.0 if part in _NEGATED else 1.0
