import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.refusals import refused
from torchrl_sparse.rotations import (
    absolute_to_pose,
    downward_quaternion,
    pose_to_absolute,
    rot6d_to_matrix,
    rot6d_to_rotvec,
    rotvec_to_rot6d,
)


def test_rot6d_is_the_first_two_rows():
    rotation = Rotation.from_rotvec([0.3, -1.2, 0.7])
    expected = rotation.as_matrix()[:2].reshape(6)
    np.testing.assert_allclose(rotvec_to_rot6d(rotation.as_rotvec()), expected)


def test_round_trip_is_the_same_rotation_also_at_pi():
    rotations = Rotation.concatenate(
        [Rotation.random(50, random_state=0), Rotation.from_rotvec([[np.pi, 0, 0]])]
    )
    back = Rotation.from_rotvec(rot6d_to_rotvec(rotvec_to_rot6d(rotations.as_rotvec())))
    assert (rotations.inv() * back).magnitude().max() < 1e-6


def test_any_two_independent_rows_become_a_rotation():
    matrices = rot6d_to_matrix(np.random.default_rng(0).normal(size=(20, 6)))
    np.testing.assert_allclose(
        matrices @ matrices.swapaxes(-1, -2), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0)


@pytest.mark.parametrize("rot6d", [np.zeros(6), np.array([1.0, 0, 0, 2, 0, 0]), np.full(6, 1e300)])
def test_rows_that_fix_no_rotation_are_refused(rot6d):
    with refused("rot6d"):
        rot6d_to_matrix(rot6d)


@pytest.mark.parametrize("angle", [1e30, 101.0, np.inf, np.nan])
def test_rotation_vectors_of_no_angle_are_refused(angle):
    pose = np.zeros((2, 7))
    pose[1, 4] = angle
    with refused("rotation vector"):
        pose_to_absolute(pose)


def test_no_poses_become_no_actions():
    assert pose_to_absolute(np.zeros((0, 7))).shape == (0, 10)


def test_actions_of_two_arms_round_trip():
    rng = np.random.default_rng(1)
    pose = rng.normal(size=(5, 14))
    absolute = pose_to_absolute(pose)
    assert absolute.shape == (5, 20)
    np.testing.assert_array_equal(
        absolute[:, [0, 1, 2, 9, 10, 11, 12, 19]], pose[:, [0, 1, 2, 6, 7, 8, 9, 13]]
    )
    np.testing.assert_allclose(pose_to_absolute(absolute_to_pose(absolute)), absolute, atol=1e-9)


def test_action_of_a_wrong_size_is_named():
    with refused("action"):
        absolute_to_pose(np.zeros(7))


def test_quaternion_sign_is_continuous_around_the_rest_orientation():
    rest = Rotation.from_quat([1, 1, 0, 0])
    yaws = [Rotation.from_euler("z", angle, degrees=True) for angle in range(-170, 171, 2)]
    quats = np.array([downward_quaternion((yaw * rest).as_quat()) for yaw in yaws])
    assert np.abs(np.diff(quats, axis=0)).max() < 0.05
