"""An obstacle that may be passed on several equally good sides: a task with several modes by construction.

The obstacle is not simulated: an episode fails once the grip site enters it. So a policy that averages over the ways of its
demonstrations, which pass on all sides, goes into it; one that knows a single way succeeds, but its rollouts have less entropy
than the demonstrations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY

__all__ = ["Detour", "Obstacle"]


@dataclass(frozen=True)
class Obstacle:
    """An obstacle and the ways around it. Positions are relative to its centre, f64 [3] in m.

    Attributes:
        radius: m.
        along: unit vector of the straight way, past the obstacle.
        directions: unit vectors from the obstacle to where each way passes it.
        upright: whether it is a pillar, at any height, instead of a ball.
    """

    radius: float
    along: Sequence[float]
    directions: Sequence[Sequence[float]]
    upright: bool = False

    def holds(self, places: np.ndarray) -> np.ndarray:
        """Tell, bool [...], which positions [..., 3] are inside."""
        return np.linalg.norm(places[..., : 2 if self.upright else 3], axis=-1) < self.radius

    def passed(self, places: np.ndarray) -> np.ndarray:
        """Return how far positions [..., 3] are beyond the obstacle, m; negative before it."""
        return places @ np.asarray(self.along)

    def side(self, place: np.ndarray) -> int:
        """Return the mode to which a position [3] belongs."""
        return int((np.asarray(self.directions) @ place).argmax())

    def way_of(self, places: np.ndarray) -> int:
        """Return the mode of an episode's positions [T, 3]; `NO_WAY` if short of the obstacle, `BETWEEN` if any is inside.

        >>> ball = Obstacle(0.03, (1, 0, 0), [(0, 1, 0), (0, -1, 0)])
        >>> ball.way_of(np.array([[-0.1, 0, 0], [0.01, -0.05, 0]])), ball.way_of(np.array([[-0.1, 0, 0]]))
        (1, -1)
        """
        if self.holds(places).any():
            return BETWEEN
        beyond = self.passed(places) > 0
        return self.side(places[beyond.argmax()]) if beyond.any() else NO_WAY


class Detour:
    """Mixin for a robosuite environment with an obstacle, whose place the subclass defines.

    Attributes:
        obstacle: what is in the way.
        centre: where it is, f64 [3], m.
        way: on which side of it the hand passed in this episode; `NO_WAY` before that, `BETWEEN` once it was inside.
    """

    obstacle: Obstacle
    centre: np.ndarray
    sim: Any
    robots: Any

    @property
    def passed(self) -> float:
        """Distance of the hand beyond the obstacle, m; negative before it."""
        return float(self.obstacle.passed(self._place()))

    def _place(self) -> np.ndarray:
        """Return the grip site relative to the obstacle, f64 [3], m."""
        return self.sim.data.site_xpos[self.robots[0].eef_site_id["right"]] - self.centre

    def _reset_internal(self) -> None:
        super()._reset_internal()  # type: ignore[misc]  # these are of robosuite's class behind it
        self.way = NO_WAY

    def _pre_action(self, action: np.ndarray, policy_step: bool = False) -> None:
        super()._pre_action(action, policy_step)  # type: ignore[misc]
        place = self._place()
        if self.obstacle.holds(place):
            self.way = BETWEEN
        elif self.way == NO_WAY and self.obstacle.passed(place) > 0:
            self.way = self.obstacle.side(place)

    def _check_success(self) -> bool:
        solved = super()._check_success()  # type: ignore[misc]
        return bool(solved) and self.way != BETWEEN
