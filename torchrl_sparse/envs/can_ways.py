"""PickPlaceCan with a pillar between the bins that the can must pass; see `torchrl_sparse.envs.detours`.

The way is chosen in mid-episode, with the can in hand. Importing this module registers ``"CanTwoWays"`` with robosuite;
`make_simulator` does so.
"""

from __future__ import annotations

import numpy as np

from torchrl_sparse.envs.detours import Detour, Obstacle
from torchrl_sparse.envs.simulator import import_robosuite

import_robosuite()  # quietly, before anything else imports it
from robosuite.environments.manipulation.pick_place import PickPlaceCan  # noqa: E402

_PILLAR = np.array([0.12, 0.015, 0.8])  # m: over the walls, where the straight way from the mean start leads


class CanTwoWays(Detour, PickPlaceCan):
    """PickPlaceCan with two modes: the can passes between pillar and robot (0) or behind the pillar (1)."""

    obstacle = Obstacle(0.03, (0.0, 1.0, 0.0), [(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)], upright=True)
    centre = _PILLAR


def way_of(states: np.ndarray) -> int:
    """Return the mode of an episode with these states, [T, 23], as the environment does: see `Obstacle.way_of`.

    >>> states = np.zeros((2, 23))
    >>> states[:, 14:17] = [[0.1, -0.1, 1.0], [0.2, 0.02, 1.0]]
    >>> way_of(states)
    1
    """
    return CanTwoWays.obstacle.way_of(states[:, 14:17] - _PILLAR)
