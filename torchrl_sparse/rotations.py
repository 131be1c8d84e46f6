"""Rotation conventions of Diffusion Policy's absolute actions.

The 6-D rotation is the first two *rows* of the rotation matrix (the pytorch3d convention, arXiv:1812.07035), not its columns.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.errors import InputError

POSE_DIM = 7
"""Position (3), rotation vector (3) and gripper (1) of one arm, as robosuite's absolute controller takes them."""

_MAX_ANGLE = 100

ABSOLUTE_DIM = 10
"""Position (3), 6-D rotation (6) and gripper (1) of one arm, as the policy predicts them."""


def matrix_to_rot6d(matrix: np.ndarray) -> np.ndarray:
    """Convert [..., 3, 3] rotation matrices to [..., 6], their first two rows."""
    return matrix[..., :2, :].reshape(*matrix.shape[:-2], 6)


def rot6d_to_matrix(rot6d: np.ndarray) -> np.ndarray:
    """Convert [..., 6] to [..., 3, 3]: Gram-Schmidt turns any two independent rows into a rotation.

    Raises:
        InputError: if the last axis is not 6, or the two rows are parallel, zero or beyond measure.
    """
    if rot6d.shape[-1] != 6:
        raise InputError(f"rot6d: expected a last axis of 6, got shape {tuple(rot6d.shape)}")
    first, second = rot6d[..., :3], rot6d[..., 3:]
    row0 = _unit(first)
    row1 = _unit(second - (row0 * second).sum(-1, keepdims=True) * row0)
    return np.stack([row0, row1, np.cross(row0, row1)], axis=-2)


def fixes_rotation(rot6d: np.ndarray) -> bool:
    """Return whether 6 numbers define a rotation; parallel rows do not.

    >>> fixes_rotation(np.array([1.0, 0, 0, 0, 1, 0])), fixes_rotation(np.ones(6))
    (True, False)
    """
    try:
        rot6d_to_matrix(rot6d)
    except ValueError:
        return False
    return True


def rotvec_to_rot6d(rotvec: np.ndarray) -> np.ndarray:
    """Convert [..., 3] rotation vectors (rad) to [..., 6].

    Raises:
        InputError: if one is longer than a hundred radians: nobody turns that far, and of 1e30 no angle is left.

    >>> rotvec_to_rot6d(np.zeros(3))
    array([1., 0., 0., 0., 1., 0.])
    """
    if rotvec.size and not (longest := np.abs(rotvec).max()) <= _MAX_ANGLE:
        raise InputError(f"rotation vector: expected at most {_MAX_ANGLE} rad, got {longest:g}")
    matrix = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix()
    return matrix_to_rot6d(matrix.reshape(*rotvec.shape[:-1], 3, 3))


def quaternion_to_rot6d(quat: np.ndarray) -> np.ndarray:
    """Convert [..., 4] unit quaternions (xyzw) to [..., 6].

    >>> quaternion_to_rot6d(np.array([0.0, 0.0, 0.0, 1.0]))
    array([1., 0., 0., 0., 1., 0.])
    """
    matrix = Rotation.from_quat(quat.reshape(-1, 4)).as_matrix()
    return matrix_to_rot6d(matrix.reshape(*quat.shape[:-1], 3, 3))


def rot6d_to_rotvec(rot6d: np.ndarray) -> np.ndarray:
    """Convert [..., 6] to [..., 3] rotation vectors (rad); the inverse of `rotvec_to_rot6d` up to 2 pi."""
    matrix = rot6d_to_matrix(rot6d)
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(*rot6d.shape[:-1], 3)


def pose_to_absolute(pose: np.ndarray) -> np.ndarray:
    """Convert [..., 7 * arms] (position, rotation vector, gripper) to [..., 10 * arms] (position, 6-D rotation, gripper)."""
    arms = _split_arms(pose, POSE_DIM)
    absolute = np.concatenate([arms[..., :3], rotvec_to_rot6d(arms[..., 3:6]), arms[..., 6:]], axis=-1)
    return absolute.reshape(*pose.shape[:-1], arms.shape[-2] * ABSOLUTE_DIM)


def absolute_to_pose(absolute: np.ndarray) -> np.ndarray:
    """Convert [..., 10 * arms] (position, 6-D rotation, gripper) to [..., 7 * arms] (position, rotation vector, gripper)."""
    arms = _split_arms(absolute, ABSOLUTE_DIM)
    pose = np.concatenate([arms[..., :3], rot6d_to_rotvec(arms[..., 3:9]), arms[..., 9:]], axis=-1)
    return pose.reshape(*absolute.shape[:-1], arms.shape[-2] * POSE_DIM)


def downward_quaternion(quat: np.ndarray) -> np.ndarray:
    """Return whichever of +q and -q (xyzw), [..., 4], is nearer to the Panda's rest pose, (1, 1, 0, 0) / sqrt(2).

    Both are the same rotation; at rest the gripper points down. Conventions based on the sign of w flip where w crosses zero,
    near a downward gripper, so a policy would see a jump without motion.
    """
    return np.where(quat[..., :1] + quat[..., 1:2] < 0, -quat, quat)


def _split_arms(flat: np.ndarray, dim: int) -> np.ndarray:
    if flat.shape[-1] == 0 or flat.shape[-1] % dim:
        raise InputError(f"action: expected {dim} numbers per arm, got a last axis of {flat.shape[-1]}")
    return flat.reshape(*flat.shape[:-1], flat.shape[-1] // dim, dim)


def _unit(vector: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    if not ((norm >= 1e-6) & np.isfinite(norm)).all():
        raise InputError("rot6d: its two rows are parallel, zero or beyond measure, so they fix no rotation")
    return vector / norm
