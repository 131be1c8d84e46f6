"""Scripted expert for ToolHang: stand the frame in the stand's hole, then hang the wrench on the frame's hook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Hand, Waypoint, at, downward

# The frame's own axes: z along the rod from its tip to the corner, x from the arm's hook to the rod.
FRAME_TIP = np.array([0.04375, 0.0, -0.13445])  # m
FRAME_HOOK = np.array([-0.04375, 0.0, 0.08625])  # m, where arm and upturned end meet, at half thickness
_FRAME_GRIP = np.array([0.04375, 0.0, 0.0525])  # m, centre of the grip on the rod
_FRAME_SIZE = (0.0254, 0.032)  # m, the grip's width and half its length
_ROD_END = (0.038, 0.055)  # m from the tip: where the thin tip ends and the square rod begins, with a margin
# The tool's: x along the handle from the hole that is hung to the other one, z along the holes.
TOOL_HOLE = np.array([-0.0936, 0.0, 0.0])  # m
_TOOL_SIZE = (0.030, 0.04)  # m, the same of the tool's grip
# The stand's.
STAND_HOLE = np.array([0.0, 0.045, 0.08])  # m, centre of the hole's rim

_STANDING = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""The frame's rotation in the hole. Of the four that fit, its hook points to where the tool lies: little to turn."""
_LEAN = np.radians(55.0)  # of the hand on the lying frame; it leans by 35 degrees on the standing one
_BOTTOM = 0.145  # m of the tip below the rim: the frame stands. It ends at 0.15
_INSIDE = 0.0055  # m from the hole's axis, a tip below the rim is in the hole and not beside it
_FIT = 0.0035  # m, misalignment at which the tip may go in; the play is 0.004
_ROD_FIT = 0.0011  # m, the same for the rod; the play is 0.00125
_FORESIGHT = 0.05  # s, how far ahead misalignment is looked at: a frame in motion is not lowered
_RETREAT = 0.16  # m from the grip that an open hand withdraws, before it goes for the tool
_NEAR_HOOK = 0.2  # m, where the hand stays above the hook
_OVER_HOOK = 0.28  # m over the tool, the height of travel there
_HOOK_TOP = 0.016  # m over the arm, the top of its upturned end
_PITCHES = np.radians([25.0, 40.0, 50.0, 65.0])  # the tool's, from above the hook's end to its arm
_HUNG = 0.012  # m along the arm, where the tool is let go of


@dataclass(frozen=True)
class Pose:
    """A body's f64 [3] position, m, and f64 [3, 3] rotation."""

    position: np.ndarray
    rotation: np.ndarray

    def point(self, local: np.ndarray) -> np.ndarray:
        """Return the world position, f64 [3] in m, of a point of the body."""
        return self.position + self.rotation @ local


class ToolHangExpert(Expert):
    """Expert that grasps the frame with a tilted hand and stands it up by tilting to the other side of the vertical.

    The tool is grasped from above: with a hand that leans, the forearm would knock the frame over. Both things are
    placed by their own pose in the hand, whatever that is, and the tool relative to the frame as it really stands:
    it has play, up to 25 degrees about the vertical.
    """

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        frame, tool, stand = (Pose(*self.body(part.root_body)) for part in self._parts)
        off = frame.point(FRAME_TIP) - stand.point(STAND_HOLE)
        if in_hole(off) and off[2] < -_BOTTOM:
            return [self._hang(hand, frame, tool)]
        if holds(hand, frame, _FRAME_GRIP, 2, _FRAME_SIZE):
            return [self._insert(hand, frame, off) if in_hole(off) else self._stand_up(hand, frame, off)]
        return [self._grasp(hand, frame.point(_FRAME_GRIP), frame.rotation @ _FRAME_GRASP)]

    @property
    def _parts(self) -> tuple[Any, Any, Any]:
        return self.sim_env.frame, self.sim_env.tool, self.sim_env.stand

    def _grasp(self, hand: Hand, grip: np.ndarray, aligned: np.ndarray) -> Waypoint:
        if at(hand, grip, aligned, position=0.01):
            return Waypoint(grip, aligned, CLOSED)
        left = Rotation.from_matrix(aligned @ hand.rotation.T).magnitude()
        return Waypoint(self.above(hand, grip, turn=left), aligned, OPEN, pace=0.7)

    # -- the frame --------------------------------------------------------------------------------

    @staticmethod
    def _insert(hand: Hand, frame: Pose, off: np.ndarray) -> Waypoint:
        """Return the next step down the hole; ``off`` is the tip's f64 [3] offset from the centre of the hole's rim, m."""
        tip = frame.point(FRAME_TIP)
        goal = tip - np.array([off[0], off[1], descent(off, frame.rotation[:, 2])])
        turn = Rotation.from_matrix(_STANDING @ frame.rotation.T)
        return Waypoint(*_carried(hand, tip, goal, turn), CLOSED, pace=0.4)

    @staticmethod
    def _stand_up(hand: Hand, frame: Pose, off: np.ndarray) -> Waypoint:
        """Return the next step of the frame to over the hole, and of its tip into it once they are aligned."""
        tip = frame.point(FRAME_TIP)
        turn = Rotation.from_matrix(_STANDING @ frame.rotation.T)
        ahead = [np.abs(off[:2] + time * hand.velocity[:2]).max() for time in (0.0, _FORESIGHT)]
        misfit = max(ahead) + 0.03 * turn.magnitude()
        height = np.clip(20.0 * (misfit - _FIT) - 0.015, -0.015, 0.02)
        position, _ = _carried(hand, tip, tip - np.array([off[0], off[1], off[2] - height]), turn)
        position = _sideways(hand, position, off[2] / 0.02)
        lifted = np.clip((tip[2] - 0.84) / 0.05, 0.0, 1.0)  # lower, the tip would turn into the table
        turned = Rotation.from_rotvec(lifted * turn.as_rotvec()).as_matrix() @ hand.rotation
        return Waypoint(position, turned, CLOSED, pace=0.4 if misfit < 0.08 else 0.8)

    # -- the tool ---------------------------------------------------------------------------------

    def _hang(self, hand: Hand, frame: Pose, tool: Pose) -> Waypoint:
        hole = from_hook(frame, tool.point(TOOL_HOLE))
        if around(hole) and hole[0] < -_HUNG:
            return self._let_go(hand, backwards=hand.opening > _TOOL_SIZE[0] + 0.01)
        if holds(hand, tool, np.zeros(3), 0, _TOOL_SIZE):
            return self._thread(hand, frame, tool, hole)
        grip, hook, handle = (
            np.linalg.norm(hand.position - point)
            for point in (frame.point(_FRAME_GRIP), frame.point(FRAME_HOOK), tool.position)
        )
        if grip < min(_RETREAT, handle):
            return self._let_go(hand, backwards=hand.opening > _FRAME_SIZE[0] + 0.01)
        if hook < min(_NEAR_HOOK, handle):
            goal = self.above(hand, tool.position, clearance=_OVER_HOOK)
            return Waypoint(goal, downward(hand.yaw), OPEN, pace=0.7)
        return self._grasp(hand, tool.position, tool.rotation @ _TOOL_GRASP)

    @staticmethod
    def _let_go(hand: Hand, backwards: bool) -> Waypoint:
        back = -0.15 * hand.rotation[:, 2] if backwards else np.zeros(3)
        return Waypoint(hand.position + back, hand.rotation, OPEN, pace=0.7)

    @staticmethod
    def _thread(hand: Hand, frame: Pose, tool: Pose, hole: np.ndarray) -> Waypoint:
        """Bring the tool's hole, at ``hole`` m from the hook, over its upturned end, and round the corner."""
        threaded = around(hole)
        goal, pitch = along_hook(hole) if threaded else over_hook(hole)
        turn = Rotation.from_matrix(frame.rotation @ hanging(pitch) @ tool.rotation.T)
        target = frame.point(FRAME_HOOK) + frame.rotation @ (_HOOK_AXES @ goal)
        position, rotation = _carried(hand, tool.point(TOOL_HOLE), target, turn)
        if not threaded:  # from below, it would push the frame over
            position = _sideways(hand, position, (hole[2] - _HOOK_TOP) / 0.01)
        careful = threaded or np.hypot(hole[0], hole[1]) < 0.023
        return Waypoint(position, rotation, CLOSED, pace=0.3 if careful else 0.7)


# -- geometry ---------------------------------------------------------------------------------------

_HOOK_AXES = np.diag([-1.0, 1.0, 1.0])  # from (outward, sideways, up) to the frame's own axes


def from_hook(frame: Pose, point: np.ndarray) -> np.ndarray:
    """Return a world point relative to the hook's corner, f64 [3] in m: outward along the arm, sideways, along the rod."""
    return _HOOK_AXES @ frame.rotation.T @ (point - frame.point(FRAME_HOOK))


def in_hole(off: np.ndarray) -> bool:
    """Tell whether a tip, ``off`` f64 [3] m from the centre of the hole's rim, is in the hole."""
    return bool(off[2] < -0.005 and np.abs(off[:2]).max() < _INSIDE)


def descent(off: np.ndarray, up: np.ndarray) -> float:
    """Return how far, m, a frame with its tip in the hole may descend: none while its rod would land on the rim."""
    misfit = np.abs(off[:2] - off[2] * up[:2] / up[2]).max()  # of the rod's axis, at the height of the rim
    at_rod = _ROD_END[0] < -off[2] < _ROD_END[1]
    return float(np.clip(0.015 - 30.0 * max(0.0, misfit - (_ROD_FIT if at_rod else 0.003)), -0.005, 0.015))


def holds(hand: Hand, body: Pose, grip: np.ndarray, axis: int, size: tuple[float, float]) -> bool:
    """Tell whether the fingers are around a body's grip and closed to its width.

    Args:
        hand: whose fingers.
        body: the body's pose.
        grip: f64 [3] its grip's centre, m, in its own axes.
        axis: the grip's long axis.
        size: the grip's width and half its length, m.
    """
    offset = body.rotation.T @ (hand.position - body.point(grip))
    across = np.delete(offset, axis)
    near = abs(offset[axis]) < size[1] and np.linalg.norm(across) < 0.022
    return bool(near and -0.005 < hand.opening - size[0] < 0.007)  # what is held askew is wider


def around(hole: np.ndarray) -> bool:
    """Tell whether the hook is inside the tool's hole, given the hole's centre ``hole`` f64 [3] m from the hook's corner."""
    outward, sideways, up = hole
    around_end = -0.008 < up < _HOOK_TOP + 0.001 and abs(outward) < 0.008
    around_arm = outward < 0.0 and abs(up) < 0.009
    return bool(abs(sideways) < 0.007 and (around_end or around_arm))


def over_hook(hole: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the next goal of the hole's centre on its path to the hook's upturned end; see `along_hook`."""
    misfit = max(0.0, float(np.hypot(hole[0], hole[1])) - 0.003)
    return np.array([0.0, 0.0, min(0.01 + 10.0 * misfit, 0.05)]), float(_PITCHES[0])


def along_hook(hole: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the next goal of the hole's centre on its path down the hook's end and inward along its arm.

    The hole is 19 mm wide and the hook 20 mm high, so the tool cannot be slid over it level: its axis turns from
    near the upturned end's direction to near the arm's.

    Args:
        hole: f64 [3] its centre now, m from the hook's corner.

    Returns:
        f64 [3] the next one, and the tool's pitch, rad, see `hanging`.
    """
    done = -hole[0] - max(hole[2], 0.0) + 0.008  # m along the way, 0 at the corner; a little more than now
    inward, up = max(done, 0.0), max(-done, 0.0)
    if abs(done) < 0.003:  # cut the corner: the ring is thick
        inward, up = (0.003 + done) / 2, (0.003 - done) / 2
    return np.array([-inward, 0.0, up]), float(np.interp(done, [-0.02, -0.004, 0.006, 0.02], _PITCHES))


def hanging(pitch: float) -> np.ndarray:
    """Return the tool's rotation f64 [3, 3] in the frame's axes: handle outward, ``pitch`` rad below the arm's direction."""
    c, s = np.cos(pitch), np.sin(pitch)
    return _HOOK_AXES @ np.array([[c, 0.0, s], [0.0, -1.0, 0.0], [-s, 0.0, c]])


def _leaning(forward: np.ndarray, down: np.ndarray, angle: float) -> np.ndarray:
    """Return f64 [3, 3] of a hand that points along ``down``, leaning by ``angle`` rad to ``forward``."""
    approach = np.cos(angle) * down + np.sin(angle) * forward
    palm = np.cos(angle) * forward - np.sin(angle) * down
    return np.stack([np.cross(palm, approach), palm, approach], axis=1)


_X, _Y, _Z = np.eye(3)
_FRAME_GRASP = _leaning(-_Z, _Y, _LEAN)  # the frame lies with y down
_TOOL_GRASP = _leaning(-_X, -_Z, 0.0)


def _carried(
    hand: Hand, point: np.ndarray, goal: np.ndarray, turn: Rotation
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and rotation of a hand that turns what it holds by ``turn`` and brings its ``point`` to ``goal``."""
    return goal + turn.apply(hand.position - point), turn.as_matrix() @ hand.rotation


def _sideways(hand: Hand, position: np.ndarray, share: float) -> np.ndarray:
    """Return f64 [3] ``position`` with this share, 0 to 1, of the horizontal way there: what is held rises first."""
    travelled = position.copy()
    travelled[:2] = hand.position[:2] + np.clip(share, 0.0, 1.0) * (position - hand.position)[:2]
    return travelled
