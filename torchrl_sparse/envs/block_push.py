"""Block pushing, two blocks into two squares in any order, after Diffusion Policy (arXiv:2303.04137); extra ``blockpush``.

A re-creation, since the published assets cannot be installed. As published: sizes, masses and friction of blocks, squares and
tip, gravity, the workspace's bounds, 10 Hz, where episodes start, observations, actions, rewards and tolerance. Not as
published: there is no xArm. The tip of its end effector is held upright by a constraint, whose anchor closes a tenth of the
distance to the target in each of 24 simulation steps, as pybullet's default position control of the arm's joints would do
without load; it lags a little, but cannot miss or collide as an arm can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torchrl.data import Bounded

from torchrl_sparse.envs.block_push_scene import WORKSPACE, BlockPushScene, published_start
from torchrl_sparse.envs.seeded import SeededEnv

__all__ = ["TOLERANCE", "BlockPushEnv", "way_of"]

TOLERANCE = 0.05  # m between the centres of a block and a target, below which the block is in it
HORIZON = 350
_FIRST, _BOTH = 0.49, 0.51  # rewards


class BlockPushEnv(SeededEnv):
    """Two blocks and two target squares at 10 Hz: push each block into a square of its own. Episodes: see `SeededEnv`.

    The state is the published one, f32 [16], m and rad: x, y and yaw of each block; x, y of the tip; x, y of the tip's target;
    x, y and yaw of each square. Yaws are taken modulo pi. The action, f32 [2], shifts the tip's target by x and y, m.

    The reward is 0.49 whenever a block enters a square for the first time and 0.51 when both blocks are in different squares,
    which is success. ``("episode", "completed")`` counts the published levels: 1 once a block was in a square (p1), 2 on
    success (p2). ``("episode", "way")`` tells which of the four orders this is: 2 b + s once block b, the first to enter any
    square, has entered square s. The episode of seed s starts where the published one does.

    Args:
        horizon: steps until truncation; 350 by default, as published.
        seeds: see `SeededEnv`.

    Raises:
        ImportError: without pybullet, with the command that installs it.

    Examples:
        >>> env = BlockPushEnv(seeds=[100000])  # doctest: +SKIP
        >>> env.reset()["observation", "state"].shape  # doctest: +SKIP
        torch.Size([16])
    """

    action_mode = "delta"

    def __init__(
        self,
        *,
        horizon: int | None = None,
        seeds: Sequence[int] | None = None,
        device: torch.device | str = "cpu",
    ):
        self.scene = BlockPushScene()
        horizon = HORIZON if horizon is None else horizon
        super().__init__(horizon=horizon, seeds=seeds, counts_parts=True, tells_way=True, device=device)
        self._make_specs(16, Bounded(-0.1, 0.1, (2,)))

    def _start(self, seed: int) -> None:
        start = published_start(seed)
        self.scene.reset(start)
        self.targets = start.targets
        self._tip_target = self.scene.tip_position()
        self._entered = np.zeros((2, 2), dtype=bool)
        self._first_entry = -1

    def _advance(self, action: np.ndarray) -> float:
        self._tip_target = np.clip(self._tip_target + action, *WORKSPACE)
        self.scene.step(self._tip_target)
        inside = self._distances() < TOLERANCE
        entering = inside & ~self._entered
        self._entered |= inside
        if self._first_entry < 0:
            self._first_entry = _first(inside)
        return _BOTH if self._is_solved() else _FIRST * float(entering.sum())

    def _observe_state(self) -> np.ndarray:
        blocks, targets = np.stack([self.scene.block_pose(i) for i in range(2)]), self.targets.copy()
        blocks[:, 2] %= np.pi
        targets[:, 2] %= np.pi
        tip = self.scene.tip_position()
        return np.concatenate([blocks.ravel(), tip, self._tip_target, targets.ravel()])

    def _is_solved(self) -> bool:
        distances = self._distances()
        nearest = distances.argmin(1)
        return bool((distances.min(1) < TOLERANCE).all() and nearest[0] != nearest[1])

    def _parts_done(self) -> int:
        return 2 if self._is_solved() else int(self._entered.any())

    def _way(self) -> int:
        return self._first_entry

    def _distances(self) -> np.ndarray:
        blocks = np.stack([self.scene.block_pose(i)[:2] for i in range(2)])
        return _distances(blocks, self.targets[:, :2])

    def render(self, camera: str = "", height: int = 256, width: int = 256) -> np.ndarray:
        """Return a u8 [height, width, 3] picture of the workspace; the only view, whatever the ``camera``."""
        return self.scene.render(height, width)

    def close(self, *, raise_if_closed: bool = True) -> None:
        self.scene.close()
        super().close(raise_if_closed=raise_if_closed)


def way_of(states: np.ndarray) -> int:
    """Return the mode of an episode with these states, [T, 16], as `BlockPushEnv` numbers it; -1 if no block enters a square.

    >>> states = np.zeros((2, 16))
    >>> states[:, [0, 10, 13]] = [0.5, 0.1, 0.3]  # x of block 0 and of both squares; block 1 stays at 0
    >>> states[1, 0] = 0.32
    >>> way_of(states)
    1
    """
    blocks, squares = states[:, [[0, 1], [3, 4]]], states[:, [[10, 11], [13, 14]]]
    inside = _distances(blocks, squares) < TOLERANCE
    return _first(inside[inside.any((1, 2)).argmax()])


def _distances(blocks: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return the distances, [..., 2, 2] in m, between centres of blocks (rows) and squares (columns), both [..., 2, 2]."""
    return np.linalg.norm(blocks[..., :, None, :] - squares[..., None, :, :], axis=-1)


def _first(inside: np.ndarray) -> int:
    """Return the index of the first block and square that fit, in a flattened bool [2, 2]; -1 if none do."""
    return int(inside.argmax()) if inside.any() else -1
