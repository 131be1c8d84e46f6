"""Lift with something in the way, which may be passed on several sides that are equally good.

A ball hangs between the hand and the cube, where the straight way to it leads. It is not simulated: whoever takes the grip site
into it has failed the episode. So a policy that averages over the ways of its demonstrations, which pass on all sides, goes
through the ball; one that knows a single way succeeds, but its rollouts have less entropy than the demonstrations.

Importing this module registers ``"LiftTwoWays"`` and ``"LiftFourWays"`` with robosuite; `make_simulator` does so.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.envs.simulator import import_robosuite

import_robosuite()  # quietly, before anything else imports it
from robosuite.environments.manipulation.lift import Lift  # noqa: E402

RADIUS = 0.03  # m, of the ball
_FROM_CUBE = np.array([-0.05, 0.0, 0.085])  # m, half of the way from the cube to where hands start
_ALONG = -_FROM_CUBE / np.linalg.norm(_FROM_CUBE)
_LEFT = np.array([0.0, 1.0, 0.0])
_UP = np.cross(_ALONG, _LEFT)  # away from the table


def directions(ways: int) -> np.ndarray:
    """Return unit vectors, f64 [ways, 3], from the ball to where each way passes it: from its left over it to its right.

    >>> directions(2).round(3).tolist()[0]
    [0.0, 1.0, 0.0]
    """
    angles = np.linspace(0, np.pi, ways)[:, None]
    return np.cos(angles) * _LEFT + np.sin(angles) * _UP


def way_of(states: np.ndarray, ways: int) -> int:
    """Return the way of an episode with these states, [T, 19], as the environment tells it; `NO_WAY` short of the ball.

    Args:
        states: of the task: the cube's position first, the hand's from the eleventh number on.
        ways: on how many sides demonstrations pass the ball.

    >>> states = np.zeros((2, 19))
    >>> states[:, 10:13] = [[-0.1, 0, 0.17], [-0.04, -0.08, 0.08]]  # past the ball, on its right
    >>> way_of(states, 2)
    1
    """
    hands = states[:, 10:13] - (states[0, :3] + _FROM_CUBE)
    if (np.linalg.norm(hands, axis=1) < RADIUS).any():
        return BETWEEN
    passed = hands @ _ALONG > 0
    return int((directions(ways) @ hands[passed.argmax()]).argmax()) if passed.any() else NO_WAY


way_of_two, way_of_four = partial(way_of, ways=2), partial(way_of, ways=4)


class LiftWays(Lift):
    """Lift behind a ball that hangs at a fixed offset from where the cube starts.

    Attributes:
        along: unit vector, f64 [3], of the straight way from where hands start to the cube.
        ways: on how many sides demonstrations pass the ball.
        way: on which of them the hand passed it in this episode; `NO_WAY` before that, `BETWEEN` once it was inside.
    """

    ways: int
    along = _ALONG

    @property
    def directions(self) -> np.ndarray:
        """See the function `directions`."""
        return directions(self.ways)

    def _reset_internal(self) -> None:
        super()._reset_internal()
        self.way = NO_WAY
        self._ball: np.ndarray | None = None

    @property
    def ball(self) -> np.ndarray:
        """Centre of the ball, f64 [3], m."""
        if self._ball is None:  # not at the reset: a restored state is only set after it
            self._ball = self.sim.data.body_xpos[self.cube_body_id] + _FROM_CUBE
        return self._ball

    @property
    def passed(self) -> float:
        """How far the hand is beyond the ball on the way to the cube, m; negative before it."""
        return float(self._hand() @ _ALONG)

    def _hand(self) -> np.ndarray:
        """Return the grip site relative to the ball, f64 [3], m."""
        return self.sim.data.site_xpos[self.robots[0].eef_site_id["right"]] - self.ball

    def _pre_action(self, action, policy_step: bool = False) -> None:
        super()._pre_action(action, policy_step)
        if np.linalg.norm(hand := self._hand()) < RADIUS:
            self.way = BETWEEN
        elif self.way == NO_WAY and self.passed > 0:
            self.way = int((self.directions @ hand).argmax())

    def _check_success(self) -> bool:
        return bool(super()._check_success()) and self.way != BETWEEN


class LiftTwoWays(LiftWays):
    """The ball is passed on its left (0) or right (1)."""

    ways = 2


class LiftFourWays(LiftWays):
    """The ball is passed on its left (0), above to the left (1), above to the right (2), or right (3)."""

    ways = 4
