"""ToolHang's expert: its constants are the simulator's, and the way it threads the tool on is free of the hook."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import Hand, downward
from torchrl_sparse.envs.experts.tool_hang import (
    FRAME_HOOK,
    FRAME_TIP,
    STAND_HOLE,
    TOOL_HOLE,
    Pose,
    along_hook,
    around,
    descent,
    from_hook,
    hanging,
    holds,
    in_hole,
    over_hook,
)
from torchrl_sparse.envs.robosuite import RobosuiteEnv

TURNED = Pose(np.array([0.3, -0.2, 0.9]), Rotation.from_euler("zyx", [0.7, -0.4, 0.2]).as_matrix())
UPRIGHT = np.array([0.0, 0.0, 1.0])

# The hook as boxes of (outward, up), m from its corner, and the tool's ring: half its height, inner and outer radius
# where it is flat.
ARM = ((-0.09, 0.00375), (-0.00375, 0.00375))
END = ((-0.00375, 0.00375), (-0.00375, 0.01575))
RING = (0.0035, 0.0097, 0.0162)


@pytest.fixture(scope="module")
def sim_env():
    env = RobosuiteEnv("ToolHang", seeds=[3])
    env.reset()
    yield env.sim_env
    env.close()


def pose(sim_env, part):
    data, index = sim_env.sim.data, sim_env.obj_body_id[part]
    return Pose(data.body_xpos[index], data.body_xmat[index].reshape(3, 3))


def site(sim_env, name):
    return sim_env.sim.data.site_xpos[sim_env.obj_site_id[name]]


def test_points_of_the_bodies_are_the_simulators(sim_env):
    frame, tool, stand = (pose(sim_env, part) for part in ("frame", "tool", "stand"))
    np.testing.assert_allclose(frame.point(FRAME_TIP), site(sim_env, "frame_tip_site"), atol=1e-4)
    np.testing.assert_allclose(tool.point(TOOL_HOLE), site(sim_env, "tool_hole1_center"), atol=1e-4)
    half = sim_env.frame_args["frame_thickness"] / 2
    np.testing.assert_allclose(from_hook(frame, site(sim_env, "frame_hang_site")), [half, 0, 0], atol=1e-4)
    walls = [sim_env.sim.data.geom_xpos[sim_env.obj_geom_id[f"stand_wall_{i}"]] for i in range(4)]
    hole = [*np.mean(walls, axis=0)[:2], site(sim_env, "stand_mount_site")[2]]
    np.testing.assert_allclose(stand.point(STAND_HOLE), hole, atol=1e-4)


def test_place_relative_to_the_hook_moves_with_the_frame():
    along_arm = TURNED.point(FRAME_HOOK + np.array([0.05, 0.002, 0.001]))
    np.testing.assert_allclose(from_hook(TURNED, along_arm), [-0.05, 0.002, 0.001], atol=1e-12)


@pytest.mark.parametrize("pitch", np.radians([0.0, 25.0, 65.0, 90.0]))
def test_handle_of_the_hanging_tool_points_outward_and_down(pitch):
    rotation = hanging(pitch)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation[:, 0], [-np.cos(pitch), 0.0, -np.sin(pitch)], atol=1e-12)
    assert rotation[:, 2] @ UPRIGHT == pytest.approx(np.cos(pitch))


def overlap(hole, pitch):
    """How deep the ring and the hook overlap, m. By sampling the hook's boxes, in the plane of arm and end."""
    height, inner, outer = RING
    handle, axis = hanging(pitch)[[0, 2]][:, [0, 2]].T * [[-1.0, 1.0]]
    deepest = 0.0
    for (left, right), (bottom, top) in (ARM, END):
        points = np.stack(np.meshgrid(np.linspace(left, right, 400), np.linspace(bottom, top, 50)), axis=-1)
        offset = points - [hole[0], hole[2]]
        across = np.abs(offset @ handle)
        depth = np.minimum(height - np.abs(offset @ axis), across - inner)
        deepest = max(deepest, float(depth[across < outer].max(initial=0.0)))
    return deepest


def threaded(hole, step=0.001):
    """The poses of a tool that follows the expert's goals exactly, until it hangs."""
    while hole[0] > -0.015:
        goal, pitch = along_hook(hole) if around(hole) else over_hook(hole)
        yield hole, pitch
        hole = hole + (goal - hole) * min(1.0, step / np.linalg.norm(goal - hole))


def test_tool_passes_over_the_hook():
    poses = list(threaded(np.array([0.002, 0.001, 0.05])))
    assert len(poses) < 200
    # The frame's play in its hole, 1.25 mm, is more than the path's roundness at the corner takes of it.
    assert max(overlap(hole, pitch) for hole, pitch in poses) < 0.0002
    pitches = [pitch for _, pitch in poses]
    assert pitches == sorted(pitches)
    assert np.degrees([pitches[0], pitches[-1]]) == pytest.approx([25.0, 65.0], abs=1.0)


@pytest.mark.parametrize("pitch", np.radians([25.0, 90.0]))
def test_tool_that_does_not_turn_meets_the_hook(pitch):
    poses = threaded(np.array([0.002, 0.001, 0.05]))
    assert max(overlap(hole, pitch) for hole, _ in poses) > 0.001


def test_hole_is_around_the_hook_only_where_the_hook_is():
    assert around(np.array([0.0, 0.0, 0.012]))
    assert around(np.array([-0.03, 0.0, -0.006]))
    for beside in ([0.0, 0.0, 0.02], [0.012, 0.0, 0.0], [0.0, 0.01, 0.01], [-0.03, 0.0, 0.02]):
        assert not around(np.array(beside))


def test_misaligned_tool_stays_over_the_hook():
    goal, _ = over_hook(np.array([0.01, 0.0, 0.05]))
    assert goal[2] > 0.03
    goal, _ = over_hook(np.array([0.001, 0.0, 0.03]))
    assert goal[2] < 0.016


def test_tip_beside_the_hole_or_over_it_is_not_inside():
    assert in_hole(np.array([0.003, -0.003, -0.02]))
    assert not in_hole(np.array([0.009, 0.0, -0.02]))
    assert not in_hole(np.array([0.0, 0.0, 0.01]))


def test_rod_goes_down_only_where_it_fits_through_the_rim():
    assert descent(np.array([0.002, 0.0, -0.02]), UPRIGHT) > 0  # the thin tip has more play
    assert descent(np.array([0.0, 0.0, -0.045]), UPRIGHT) > 0
    assert descent(np.array([0.002, 0.0, -0.045]), UPRIGHT) <= 0
    leaning = np.array([0.05, 0.0, 1.0])  # its tip is centred, the rod's end over it is not
    assert descent(np.array([0.0, 0.0, -0.045]), leaning) <= 0


def test_fingers_hold_a_grip_that_they_surround_and_touch():
    grip, size = np.array([0.01, 0.0, 0.05]), (0.025, 0.03)

    def hand(offset, opening):
        return Hand(TURNED.point(grip + offset), downward(0.0), np.zeros(3), opening)

    assert holds(hand([0.0, 0.005, 0.025], 0.0255), TURNED, grip, 2, size)
    assert not holds(hand([0.0, 0.005, 0.025], 0.08), TURNED, grip, 2, size)
    assert not holds(hand([0.0, 0.005, 0.025], 0.0), TURNED, grip, 2, size)  # closed, the grip slipped out
    assert not holds(hand([0.0, 0.03, 0.0], 0.0255), TURNED, grip, 2, size)
    assert not holds(hand([0.0, 0.0, 0.04], 0.0255), TURNED, grip, 2, size)
