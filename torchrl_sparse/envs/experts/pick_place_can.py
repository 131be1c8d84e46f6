"""Scripted experts for PickPlaceCan: grasp the can, carry it over the walls, put it into its bin and let go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Hand, Waypoint, at, downward, nearest

_WIDTH = 0.05  # m, the can's diameter
_WALLS = 0.92  # m, the can's height from which it may travel sideways
_CARRY = 0.13  # m over the place of release
_PLACE = np.array([-0.04, -0.04])  # m from the bin's centre, where the arm need not stretch
_BESIDE = 0.07  # m from a wall across y, within which open fingers that move along y would meet it; no episode begins there
_BERTH = 0.09  # m from the pillar's centre, at which it is passed
_RELEASE = 0.12  # m over the bin's floor, the can's height when let go: half of it below the walls' top


class PickPlaceCanExpert(Expert):
    """Expert that grasps an upright can with an unturned hand, one by a wall with a turned hand, a toppled one
    across its axis.
    """

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        can, rotation = self.body(self._object.root_body)
        grasp, aligned = self._grasp_pose(hand, can, rotation)
        held = bool(np.linalg.norm(hand.position - can) < 0.035 and hand.opening < _WIDTH + 0.004)
        if self._over_bin(can, margin=0.035) and can[2] < self._bin[2] + _RELEASE + 0.012:
            return [self._let_go(hand, held)]
        if held:
            return [self._carry(hand, can)]
        if at(hand, grasp, aligned, position=0.012):
            return [Waypoint(grasp, aligned, CLOSED)]
        return [Waypoint(self.above(hand, grasp), aligned, OPEN)]

    @property
    def _object(self) -> Any:
        return self.sim_env.objects[self.sim_env.object_id]

    @property
    def _bin(self) -> np.ndarray:
        return self.sim_env.target_bin_placements[self.sim_env.object_id]

    def _grasp_pose(self, hand: Hand, can: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axis = rotation[:, 2]
        if abs(axis[2]) > 0.7:
            aligned = downward(nearest(np.pi / 2, hand.yaw, np.pi) if self._beside_wall(can) else 0.0)
            return can + np.array([0.0, 0.0, 0.012]) + self.style.offset * aligned[:, 1], aligned
        # Fingers move along the world's y axis at yaw 0; across a lying can, square to the can's own axis.
        aligned = downward(nearest(np.arctan2(axis[1], axis[0]), hand.yaw, np.pi))
        return can + self.style.offset * aligned[:, 1], aligned

    def _beside_wall(self, can: np.ndarray) -> bool:
        """Tell whether the can stands near a wall across y, of either bin or in the middle of the second."""
        first, second, half = self.sim_env.bin1_pos[1], self.sim_env.bin2_pos[1], self.sim_env.bin_size[1] / 2
        walls = np.array([first - half, first + half, second - half, second, second + half])
        return bool(np.abs(can[1] - walls).min() < _BESIDE)

    def _carry(self, hand: Hand, can: np.ndarray) -> Waypoint:
        place = np.array([*(self._bin[:2] + _PLACE), self._bin[2] + _RELEASE])
        release = hand.position + place - can
        goal = self.above(hand, release, clearance=_CARRY)
        rising = np.clip((can[2] - _WALLS) / 0.04, 0.0, 1.0)
        travels = 1.0 if self._over_bin(can, margin=0.025) else rising
        goal[:2] = hand.position[:2] + travels * (self._towards(hand, goal) - hand.position[:2])
        return Waypoint(goal, downward(0.0), CLOSED)

    def _towards(self, hand: Hand, goal: np.ndarray) -> np.ndarray:
        """Return f64 [2], m: where the hand that carries the can to ``goal`` goes over the walls."""
        return goal[:2]

    def _over_bin(self, can: np.ndarray, margin: float) -> bool:
        """Tell whether the can's centre is over its quarter of the bin, ``margin`` m or more from the edge."""
        room = np.asarray(self.sim_env.bin_size[:2]) / 4 - margin
        return bool((np.abs(can[:2] - self._bin[:2]) < room).all())

    def _let_go(self, hand: Hand, held: bool) -> Waypoint:
        up = np.array([0.0, 0.0, 0.0 if held else 0.15])
        return Waypoint(hand.position + up, downward(0.0), OPEN)


class CanWaysExpert(PickPlaceCanExpert):
    """`PickPlaceCanExpert` that first carries the can to a point beside the pillar, in a randomly chosen mode.

    The sign of the operator's bow, a fair coin, chooses the way; nothing shows of it once the can is grasped.
    """

    def _towards(self, hand: Hand, goal: np.ndarray) -> np.ndarray:
        sim_env = self.sim_env
        if sim_env.passed > 0.02:
            return super()._towards(hand, goal)
        obstacle = sim_env.obstacle
        direction = np.asarray(obstacle.directions[int(self.style.bow > 0)])
        clear = (hand.position - sim_env.centre) @ direction > 0.7 * _BERTH
        beside = sim_env.centre + _BERTH * direction + (0.05 if clear else -0.06) * np.asarray(obstacle.along)
        return beside[:2]
