"""Checks that recorded actions can be the poses that a file says they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import ArrayReader
from torchrl_sparse.envs.simulator import CONTROL_FREQ
from torchrl_sparse.errors import InputError
from torchrl_sparse.rotations import POSE_DIM

__all__ = ["REACH", "TURN", "check_hands", "check_poses", "check_rate", "steps_out_of_reach"]

# m between a recorded hand and the same state's hand here; another robot or table is far off
_TOLERANCE = 1e-3

REACH = 0.3
"""m that a commanded position may lie ahead of the hand. A delta reaches 0.09, an expert of this library 0.08."""

TURN = np.pi / 2
"""rad that a commanded rotation may be from the hand's. A delta turns by 0.87 at most, an expert of this library by 0.6."""


def check_poses(
    where: str,
    actions: np.ndarray,
    positions: Sequence[np.ndarray | None],
    quaternions: Sequence[np.ndarray | None],
) -> None:
    """Refuse absolute poses that no hand could follow, such as deltas, degrees, or poses in another frame.

    Args:
        where: of the actions, for messages.
        actions: [T, 7 * arms] position (m), rotation vector (rad), gripper, in the world's frame.
        positions: of each arm's hand before each action [T, 3]; None where it is not recorded.
        quaternions: the same of its grip site [T, 4], xyzw.

    Raises:
        InputError: naming the first such step.
    """
    far, turn = steps_out_of_reach(actions, positions, quaternions)
    for values, limit, what, unit in ((far, REACH, "position", "m"), (turn, TURN, "rotation", "rad")):
        if len(steps := np.flatnonzero(values > limit)):
            raise InputError(
                f"{where}: expected absolute poses in the world's frame, each {what} within {limit:.1f} {unit} of the recorded "
                f"hand's, got one {values[steps[0]]:.2f} {unit} off at step {steps[0]}"
            )


def steps_out_of_reach(
    actions: np.ndarray, positions: Sequence[np.ndarray | None], quaternions: Sequence[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Return each step's [T] distance from hand to pose, in m and in rad, for the farthest arm; see `check_poses`."""
    far, turn = np.zeros(len(actions)), np.zeros(len(actions))
    arms = actions.reshape(len(actions), -1, POSE_DIM)
    for arm, (position, quaternion) in enumerate(zip(positions, quaternions, strict=True)):
        if position is not None:
            far = np.maximum(far, np.linalg.norm(arms[:, arm, :3] - position, axis=1))
        if quaternion is not None and np.linalg.norm(quaternion, axis=1).min() > 0:
            away = Rotation.from_rotvec(arms[:, arm, 3:6]) * Rotation.from_quat(quaternion).inv()
            turn = np.maximum(turn, away.magnitude())
    return far, turn


def check_rate(demo: Node, seconds: np.ndarray) -> None:
    """Refuse states recorded at another time step than this library's environments use."""
    apart = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    if apart > 0 and abs(apart * CONTROL_FREQ - 1) > 0.1:
        raise InputError(
            f"{demo.where}, states: expected {1 / CONTROL_FREQ} s between them, got {apart:.3f} s, another control_freq"
        )


def check_hands(demo: Node, arrays: Mapping[str, np.ndarray], length: int) -> None:
    """Refuse states whose hand positions belong to another robot, table or version of the task."""
    for key, value in arrays.items():
        if key.endswith("eef_pos") and (recorded := demo.find(key)) is not None:
            far = np.linalg.norm(ArrayReader(demo).numbers(demo, key, length) - value, axis=1).max()
            if far > _TOLERANCE:
                raise InputError(
                    f"{recorded.where}: expected the hand where the states put it, got {far:.4f} m off"
                )
