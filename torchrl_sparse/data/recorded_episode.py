"""One demonstration of a file under a policy's observation contract: its state, and actions that the hands can follow."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import ArrayReader, open_demo
from torchrl_sparse.data.recorded_control import RecordedControl
from torchrl_sparse.data.recorded_poses import check_poses
from torchrl_sparse.envs.contract import OBJECTS, Contract
from torchrl_sparse.envs.conventions import translate_objects
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import POSE_DIM, downward_quaternion, pose_to_absolute
from torchrl_sparse.storage.convention import Convention

__all__ = ["read_episode"]

_Arrays = Mapping[str, np.ndarray]

_HAND = {"eef_pos": 3, "eef_quat_site": 4}
"""What is observed of a hand that actions command, and in how many numbers."""


def read_episode(
    reader: ArrayReader,
    data: Node,
    name: str,
    wanted: Contract,
    control: RecordedControl | None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the state [T, Ds] and action [T, A] of one demonstration, f32, and its policy-driven steps.

    Poses under a controller become absolute actions, objects those of the wanted convention; without one all stay as they are.
    """
    demo, length = open_demo(data, name)
    action, where = reader.numbers(demo, "actions", length), f"{demo.where}, actions"
    hands = [
        key for key in _hand_keys(action.shape[1]) if key not in wanted.state_keys and demo.find(f"obs/{key}")
    ]
    observed = {
        key: _canonical(demo.where, key, reader.numbers(demo, f"obs/{key}", length))
        for key in (*wanted.state_keys, *hands)
    }
    if control is not None:
        action = _absolute_poses(where, action, observed)
        if OBJECTS in observed:
            observed[OBJECTS] = _translated(demo.where, observed[OBJECTS], control, wanted.convention)
    driven = demo.count("driven", default=0)
    if not 0 <= driven <= length:
        raise InputError(f"{demo.where}, driven: expected 0 to {length} steps, got {driven}")
    state = np.concatenate([observed[key] for key in wanted.state_keys], axis=1)
    return state.astype(np.float32), action.astype(np.float32), driven


def _hand_keys(action_dim: int) -> list[str]:
    """Return the observations of the hands that actions of so many numbers command, where they are poses."""
    return [f"robot{arm}_{name}" for arm in range(action_dim // POSE_DIM) for name in _HAND]


def _canonical(where: str, key: str, observed: np.ndarray) -> np.ndarray:
    """Return an observation [T, n] as environments show it: of a quaternion and its negative, one rotation, always one."""
    for name, size in _HAND.items():
        if key.endswith(name) and observed.shape[1] != size:
            raise InputError(f"{where}, obs/{key}: expected {size} numbers, got {observed.shape[1]}")
    return downward_quaternion(observed) if key.endswith("eef_quat_site") else observed


def _absolute_poses(where: str, pose: np.ndarray, observed: _Arrays) -> np.ndarray:
    """Return absolute actions [T, 10 * arms] of recorded poses [T, 7 * arms], where the observed hands can follow them."""
    if pose.shape[1] == 0 or pose.shape[1] % POSE_DIM:
        raise InputError(f"{where}: expected {POSE_DIM} numbers per arm, got shape {pose.shape}")
    try:
        absolute = pose_to_absolute(pose)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    hands = [observed.get(key) for key in _hand_keys(pose.shape[1])]
    check_poses(where, pose, hands[::2], hands[1::2])
    return absolute


def _translated(where: str, objects: np.ndarray, control: RecordedControl, wanted: Convention) -> np.ndarray:
    """Return the objects' state [T, n] as the wanted version of robosuite observes it."""
    try:
        return translate_objects(control.env_name, objects, observed=control.convention, wanted=wanted)
    except ValueError as error:
        told = f"recorded as of robosuite {control.convention}, wanted as of {wanted}"
        raise InputError(f"{where}, object: {told}: {error}") from error
