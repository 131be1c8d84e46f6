"""Lift with a ball on the straight path from the hand to the cube; see `torchrl_sparse.envs.detours`.

Importing this module registers ``"LiftTwoWays"`` and ``"LiftFourWays"`` with robosuite; `make_simulator` does so.
"""

from __future__ import annotations

import numpy as np

from torchrl_sparse.envs.detours import Detour, Obstacle
from torchrl_sparse.envs.simulator import import_robosuite

import_robosuite()  # quietly, before anything else imports it
from robosuite.environments.manipulation.lift import Lift  # noqa: E402

_FROM_CUBE = np.array([-0.05, 0.0, 0.085])  # m, half of the way from the cube to where hands start
_ALONG = -_FROM_CUBE / np.linalg.norm(_FROM_CUBE)
_LEFT = np.array([0.0, 1.0, 0.0])
_UP = np.cross(_ALONG, _LEFT)  # away from the table


def _ball(ways: int) -> Obstacle:
    """Return a ball that is passed from its left over it to its right."""
    angles = np.linspace(0, np.pi, ways)[:, None]
    return Obstacle(0.03, _ALONG, np.cos(angles) * _LEFT + np.sin(angles) * _UP)


class LiftWays(Detour, Lift):
    """Lift with a ball fixed at an offset from the cube's initial position."""

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self._centre: np.ndarray | None = None

    @property
    def centre(self) -> np.ndarray:  # type: ignore[override]  # it is only read
        """See `Detour.centre`."""
        if self._centre is None:  # not at the reset: a restored state is only set after it
            self._centre = self.sim.data.body_xpos[self.cube_body_id] + _FROM_CUBE
        return self._centre


class LiftTwoWays(LiftWays):
    """`LiftWays` with two modes: the ball is passed on its left (0) or right (1)."""

    obstacle = _ball(2)


class LiftFourWays(LiftWays):
    """`LiftWays` with four modes: left (0), above to the left (1), above to the right (2), or right (3) of the ball."""

    obstacle = _ball(4)


def way_of_two(states: np.ndarray) -> int:
    """Return the mode of an episode with these states, [T, 19], as `LiftTwoWays` does: see `Obstacle.way_of`.

    >>> states = np.zeros((2, 19))
    >>> states[:, 10:13] = [[-0.1, 0, 0.17], [-0.04, -0.08, 0.08]]  # past the ball, on its right
    >>> way_of_two(states)
    1
    """
    return LiftTwoWays.obstacle.way_of(_hands(states))


def way_of_four(states: np.ndarray) -> int:
    """Return the mode of an episode with these states, [T, 19], as `LiftFourWays` does: see `Obstacle.way_of`."""
    return LiftFourWays.obstacle.way_of(_hands(states))


def _hands(states: np.ndarray) -> np.ndarray:
    """Return where the hand was relative to the ball, [T, 3]; the cube's position is first in a state."""
    return states[:, 10:13] - (states[0, :3] + _FROM_CUBE)
