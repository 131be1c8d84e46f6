"""Scripted expert for NutAssemblySquare: grasp the nut by its handle, turn it to the peg, and slide it down."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Hand, Waypoint, at, downward, nearest

_HANDLE = np.array([0.059, 0.0, 0.004])  # m, where to grasp, in the nut's frame: well clear of the square
_HANDLE_WIDTH = 0.032  # m
_CLEAR = 0.052  # m along the handle from the nut's centre; nearer, fingers come to rest on the square
# rad, the nut's on the peg: of the four that fit, the one that keeps the arm from stretching
_PLACED_YAW = np.pi
_YAW_LIMITS = (-1.5, 3.4)  # rad, the hand's yaws that the last joint reaches, with a margin
_PEG_TOP = 0.95  # m
_ABOVE_PEG = 0.975  # m, the nut's height in travel
_INSERTED = 0.85  # m, the nut's height aimed at; success is below 0.87
_FIT = 0.005  # m, misalignment at which the nut may go down; the play is 0.0067
_LOOSE = 0.012  # m, misalignment that is put up with once the nut is around the peg
_FORESIGHT = 0.1  # s, how far ahead misalignment is looked at: a nut in motion is not lowered
_BACK = 0.12  # m short of the peg where turns are finished and a stretched arm recovers
_JAMMED = 0.15  # rad of tilt at which a nut around the peg is taken off again


class NutAssemblySquareExpert(Expert):
    """Expert that chooses, of the two grasps across the handle, the one with less total wrist rotation."""

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        nut, rotation = self.body(self._nut.root_body)
        handle = nut + rotation @ _HANDLE
        if np.linalg.norm(hand.position - handle) < 0.025 and abs(hand.opening - _HANDLE_WIDTH) < 0.004:
            return [self._carry(hand, nut, rotation)]
        yaw = grasp_yaw(_yaw(rotation), hand.yaw)
        grasp = handle + self.style.offset * rotation[:, 0]
        if at(hand, grasp, downward(yaw), position=0.01):
            return [Waypoint(grasp, downward(yaw), CLOSED)]
        left = yaw - _unwrapped(hand.yaw)
        goal = self.above(hand, grasp, turn=left)
        over_square = _CLEAR - rotation[:, 0] @ (hand.position - nut)  # raised, the hand slides off it again
        goal[2] = max(goal[2], grasp[2] + np.clip(8.0 * over_square, 0.0, self.style.hover))
        return [Waypoint(goal, downward(hand.yaw + _part(left)), OPEN, pace=0.7)]

    @property
    def _nut(self) -> Any:
        return self.sim_env.nuts[self.sim_env.nut_id]

    @property
    def _peg(self) -> np.ndarray:
        return self.sim_env.sim.data.body_xpos[self.sim_env.peg1_body_id]

    def _carry(self, hand: Hand, nut: np.ndarray, rotation: np.ndarray) -> Waypoint:
        turn = _turn_left(_unwrapped(hand.yaw), _yaw(rotation))
        error = self._misalignment(hand, nut) + 0.03 * abs(turn)
        around = nut[2] < _PEG_TOP - 0.01 and error < 0.03
        lifted = 1.0 if around else np.clip((nut[2] - 0.93) / 0.04, 0.0, 1.0)
        goal = nut + lifted * (self._place(hand, nut, turn, around) - nut)
        goal[2] = self._height(hand, error, around)
        turned = lifted * _part(turn)
        grip = Rotation.from_euler("z", turned).apply(hand.position - nut)
        pace = 0.4 if error < 0.08 else 0.7
        return Waypoint(goal + grip, downward(hand.yaw + turned), CLOSED, pace)

    def _misalignment(self, hand: Hand, nut: np.ndarray) -> float:
        """Return the horizontal distance of the nut to the peg, m, now or in a moment, whichever is larger."""
        now = nut[:2] - self._peg[:2]
        return float(max(np.linalg.norm(now), np.linalg.norm(now + _FORESIGHT * hand.velocity[:2])))

    def _place(self, hand: Hand, nut: np.ndarray, turn: float, around: bool) -> np.ndarray:
        """Return the place over the peg, or short of it while there is much to turn or the stretched arm tilts the hand."""
        tilted = hand.tilt > 0.1 and np.linalg.norm(nut[:2] - self._peg[:2]) < 0.08
        waiting = 0.0 if around else max(np.clip(abs(turn) / 0.5 - 0.2, 0.0, 1.0), float(tilted))
        return np.array([self._peg[0] - waiting * _BACK, self._peg[1], nut[2]])

    @staticmethod
    def _height(hand: Hand, error: float, around: bool) -> float:
        if hand.tilt > _JAMMED:
            return _ABOVE_PEG
        over = max(0.0, error - (_LOOSE if around else _FIT))
        return float(np.clip(_INSERTED + 20.0 * over, _INSERTED, _ABOVE_PEG))


def grasp_yaw(nut_yaw: float, hand_yaw: float) -> float:
    """Return the hand's yaw for grasping, rad: the nut's or its opposite; fingers move along the nut's y axis.

    Where the nuts lie, the forearm is nearly vertical, and yaws far from 0 make the wrist almost singular:
    they cost twice. The hand's present yaw keeps a choice once it is made.
    """
    grasps = [_unwrapped(nut_yaw), _unwrapped(nut_yaw + np.pi)]
    costs = {
        abs(grasp) + abs(grasp - _unwrapped(hand_yaw)) + abs(_turn_left(grasp, nut_yaw)): grasp
        for grasp in grasps
        if _reachable(grasp)
    }
    return costs[min(costs)]


def _turn_left(hand_yaw: float, nut_yaw: float) -> float:
    """Return the turn that brings the nut into its yaw on the peg, round the way that the hand can reach, rad."""
    turn = nearest(_PLACED_YAW - nut_yaw, 0.0, 2 * np.pi)
    ways = [turn, turn - np.sign(turn) * 2 * np.pi]
    return min(ways, key=lambda way: (not _reachable(hand_yaw + way), abs(way)))


def _part(turn: float) -> float:
    """Return the beginning of a turn, since the shorter way round would be taken of one beyond pi."""
    return float(np.clip(turn, -1.0, 1.0))


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _unwrapped(yaw: float) -> float:
    """Return the equivalent yaw within the last joint's range."""
    return nearest(yaw, sum(_YAW_LIMITS) / 2, 2 * np.pi)


def _reachable(yaw: float) -> bool:
    return _YAW_LIMITS[0] <= yaw <= _YAW_LIMITS[1]
