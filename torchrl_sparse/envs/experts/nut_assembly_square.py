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
_YAW_LIMITS = (-1.9, 3.0)  # rad, what the last joint reaches, with a margin
_PEG_TOP = 0.95  # m
_ABOVE_PEG = 0.975  # m, the nut's height in travel
_INSERTED = 0.85  # m, the nut's height aimed at; success is below 0.87
_FIT = 0.005  # m, misalignment at which the nut may go down; the play is 0.0067


class NutAssemblySquareExpert(Expert):
    """Chooses, of two grasps and three turns on the peg, the pair that turns the wrist least."""

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        nut, rotation = self.body(self._nut.root_body)
        handle = nut + rotation @ _HANDLE
        if np.linalg.norm(hand.position - handle) < 0.025 and hand.opening < _HANDLE_WIDTH + 0.004:
            return [self._carry(hand, nut, rotation)]
        aligned = downward(self._grasp_yaw(_yaw(rotation)))
        grasp = handle + self.style.offset * rotation[:, 0]
        if at(hand, grasp, aligned, position=0.01):
            return [Waypoint(grasp, aligned, CLOSED)]
        return [Waypoint(self.above(hand, grasp), aligned, OPEN)]

    @property
    def _nut(self):
        return self.sim_env.nuts[self.sim_env.nut_id]

    @property
    def _peg(self) -> np.ndarray:
        return self.sim_env.sim.data.body_xpos[self.sim_env.peg1_body_id]

    @staticmethod
    def _grasp_yaw(nut_yaw: float) -> float:
        """The fingers move along the nut's y axis: hand and nut have the same yaw, or opposite ones."""
        grasps = [nearest(nut_yaw, 0.0, 2 * np.pi), nearest(nut_yaw + np.pi, 0.0, 2 * np.pi)]
        turns = [nearest(yaw - nut_yaw, 0.0, 2 * np.pi) for yaw in _HANDLE_YAWS]
        pairs = [(g, t) for g, t in product(grasps, turns) if _reachable(g) and _reachable(g + t)]
        return min(pairs, key=lambda pair: abs(pair[0]) + abs(pair[1]))[0]

    def _carry(self, hand: Hand, nut: np.ndarray, rotation: np.ndarray) -> Waypoint:
        turns = [nearest(yaw - _yaw(rotation), 0.0, 2 * np.pi) for yaw in _HANDLE_YAWS]
        turn = min((t for t in turns if _reachable(hand.yaw + t)), key=abs, default=min(turns, key=abs))
        upright = Rotation.from_euler("z", _yaw(rotation) + turn).as_matrix()
        correction = upright @ rotation.T
        peg = self._peg[:2]
        error = float(np.linalg.norm(nut[:2] - peg)) + 0.03 * abs(turn)
        height = np.clip(_INSERTED + 20.0 * max(0.0, error - _FIT), _INSERTED, _ABOVE_PEG)
        free = np.clip((nut[2] - 0.02 - _PEG_TOP + 0.04) / 0.04, 0.0, 1.0) if error > 0.03 else 1.0
        goal = np.array([*(nut[:2] + free * (peg - nut[:2])), height])
        return Waypoint(goal + correction @ (hand.position - nut), correction @ hand.rotation, CLOSED)


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _reachable(yaw: float) -> bool:
    return _YAW_LIMITS[0] <= yaw <= _YAW_LIMITS[1]
