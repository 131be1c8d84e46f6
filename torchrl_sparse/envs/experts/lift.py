"""Scripted experts for Lift: close the fingers on the cube and raise it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_sparse.envs.experts.base import CLOSED, OPEN, Expert, Waypoint, at, downward, nearest

_BERTH = 0.08  # m from the ball's centre, at which it is passed
_LAG = 0.17  # s; the hand covers about a sixth of a second's way to its target in a second


class LiftExpert(Expert):
    """Expert that approaches the cube (or the named one) from above, finger axis along its nearest side, and lifts it."""

    def waypoints(self) -> Sequence[Waypoint]:
        hand = self.hand()
        cube, rotation = self.body(self.sim_env.cube.root_body)
        width = 2 * float(max(self.sim_env.cube.size[:2]))  # either side may be the one that is held
        side = np.arctan2(rotation[1, 0], rotation[0, 0])
        aligned = downward(nearest(side, hand.yaw, np.pi / 2))
        grasp = cube + self.style.offset * aligned[:, 1]
        between_fingers = np.linalg.norm(hand.position - cube) < 0.025
        if between_fingers and hand.opening < width + 0.003:
            return [Waypoint(hand.position + np.array([0.0, 0.0, 0.2]), aligned, CLOSED)]
        ahead = self.lead()
        if at(hand, grasp, aligned, position=0.012):
            return [Waypoint(grasp + ahead, aligned, CLOSED)]
        return [Waypoint(self.above(hand, grasp) + ahead, aligned, OPEN)]

    def lead(self) -> np.ndarray:
        """Return the offset at which to aim ahead of the cube, f64 [3], m."""
        return np.zeros(3)


class LiftMovingExpert(LiftExpert):
    """`LiftExpert` for a moving cube: it aims ahead by as much as the hand lags behind a moving target."""

    def lead(self) -> np.ndarray:
        velocity = self.sim_env.sim.data.get_joint_qvel(self.sim_env.cube.joints[0])[:3]
        return _LAG * np.array([velocity[0], velocity[1], 0.0])


class LiftWaysExpert(LiftExpert):
    """`LiftExpert` that first passes a ball through a point beside it, in a randomly chosen mode.

    The operator's two signs, fair coins, choose the way; the rest of what they do is small beside it.
    """

    def waypoints(self) -> Sequence[Waypoint]:
        sim_env = self.sim_env
        if sim_env.passed > 0.02:
            return super().waypoints()
        way = (2 * (self.style.bow > 0) + (self.style.offset > 0)) % len(sim_env.obstacle.directions)
        _, rotation = self.body(sim_env.cube.root_body)
        hand = self.hand()
        side = np.arctan2(rotation[1, 0], rotation[0, 0])
        direction = sim_env.obstacle.directions[way]
        clear = (hand.position - sim_env.centre) @ direction > 0.7 * _BERTH
        beside = sim_env.centre + _BERTH * direction + (0.04 if clear else -0.05) * sim_env.obstacle.along
        return [Waypoint(beside, downward(nearest(side, hand.yaw, np.pi / 2)), OPEN)]
