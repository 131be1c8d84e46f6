"""NutAssemblySquare: grasp the nut by its handle, turn it to the peg, and slide it down."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Hand, Waypoint, at, downward, nearest

_HANDLE = np.array([0.056, 0.0, 0.004])  # m, where to grasp, in the nut's frame
_HANDLE_WIDTH = 0.032  # m
_HANDLE_YAWS = (np.pi / 2, np.pi, -np.pi / 2)  # on the peg; with the handle away from the robot the arm runs out of reach
_YAW_LIMITS = (-1.6, 3.4)  # rad, what the last joint reaches, with a margin
_STRETCH = 1.5  # rad of turning that are worth having the handle towards the robot, within easy reach
_PEG_TOP = 0.95  # m
_ABOVE_PEG = 0.975  # m, the nut's height in travel
_INSERTED = 0.85  # m, the nut's height aimed at; success is below 0.87
_FIT = 0.005  # m, misalignment at which the nut may go down; the play is 0.0067
_LOOSE = 0.012  # m, misalignment that is put up with once the nut is around the peg


class NutAssemblySquareExpert(Expert):
    """Chooses, of two grasps and three turns on the peg, the pair that turns the wrist least."""

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        nut, rotation = self.body(self._nut.root_body)
        handle = nut + rotation @ _HANDLE
        if np.linalg.norm(hand.position - handle) < 0.025 and hand.opening < _HANDLE_WIDTH + 0.004:
            return [self._carry(hand, nut, rotation)]
        yaw = self._grasp_yaw(_yaw(rotation))
        grasp = handle + self.style.offset * rotation[:, 0]
        if at(hand, grasp, downward(yaw), position=0.01):
            return [Waypoint(grasp, downward(yaw), CLOSED)]
        left = yaw - _unwrapped(hand.yaw)
        return [Waypoint(self.above(hand, grasp), downward(hand.yaw + _part(left)), OPEN)]

    @property
    def _nut(self):
        return self.sim_env.nuts[self.sim_env.nut_id]

    @property
    def _peg(self) -> np.ndarray:
        return self.sim_env.sim.data.body_xpos[self.sim_env.peg1_body_id]

    @staticmethod
    def _grasp_yaw(nut_yaw: float) -> float:
        """The fingers move along the nut's y axis: hand and nut have the same yaw, or opposite ones."""
        grasps = [_unwrapped(nut_yaw), _unwrapped(nut_yaw + np.pi)]
        pairs = [(g, t) for g, t in product(grasps, _turns(nut_yaw)) if _reachable(g) and _reachable(g + t)]
        return min(pairs, key=lambda pair: abs(pair[0]) + _cost(nut_yaw, pair[1]))[0]

    def _carry(self, hand: Hand, nut: np.ndarray, rotation: np.ndarray) -> Waypoint:
        yaw = _yaw(rotation)
        turns = [turn for turn in _turns(yaw) if _reachable(_unwrapped(hand.yaw) + turn)]
        turn = min(turns or _turns(yaw), key=lambda turn: _cost(yaw, turn))
        upright = Rotation.from_euler("z", yaw + _part(turn)).as_matrix()
        correction = upright @ rotation.T
        peg = self._peg[:2]
        error = float(np.linalg.norm(nut[:2] - peg)) + 0.03 * abs(turn)
        fit = _LOOSE if nut[2] < _PEG_TOP - 0.01 else _FIT
        height = np.clip(_INSERTED + 20.0 * max(0.0, error - fit), _INSERTED, _ABOVE_PEG)
        free = np.clip((nut[2] - 0.02 - _PEG_TOP + 0.04) / 0.04, 0.0, 1.0) if error > 0.03 else 1.0
        goal = np.array([*(nut[:2] + free * (peg - nut[:2])), height])
        return Waypoint(goal + correction @ (hand.position - nut), correction @ hand.rotation, CLOSED)


def _turns(nut_yaw: float) -> list[float]:
    """Turns that bring the nut into one of its yaws on the peg, either way round."""
    turns = [nearest(yaw - nut_yaw, 0.0, 2 * np.pi) for yaw in _HANDLE_YAWS]
    return [*turns, *(turn - np.sign(turn) * 2 * np.pi for turn in turns)]


def _cost(nut_yaw: float, turn: float) -> float:
    towards_robot = np.cos(nut_yaw + turn) < -0.5
    return abs(turn) + (0.0 if towards_robot else _STRETCH)


def _part(turn: float) -> float:
    """The beginning of a turn: of a whole one beyond pi, the shorter way round would be taken, out of the joint's range."""
    return float(np.clip(turn, -1.0, 1.0))


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _unwrapped(yaw: float) -> float:
    """The equivalent yaw within the last joint's range."""
    return nearest(yaw, sum(_YAW_LIMITS) / 2, 2 * np.pi)


def _reachable(yaw: float) -> bool:
    return _YAW_LIMITS[0] <= yaw <= _YAW_LIMITS[1]
