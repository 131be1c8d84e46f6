"""Pushing two blocks into two squares: walk round behind a block, push it towards its square, then the other one."""

from __future__ import annotations

import numpy as np

from torchrl_sparse.envs.block_push import TOLERANCE

_SPEED = (0.022, 0.030)  # m per step while walking; a draw per episode
_PUSH_SPEED = (0.010, 0.014)  # m per step while pushing
_BEHIND = 0.045  # m from a block's centre, where a push begins
_CLEAR = 0.05  # m from a block's centre that a walk keeps; the corner of a block is at 0.028
_MARGIN = 0.03  # m beyond that, from where on it bends
_OFF_LINE = 0.008  # m beside the line of the push, beyond which a push begins anew
_STEERING = 0.8  # share of the distance to the line that a step of a push makes good
_HOME = 0.6 * TOLERANCE  # m to its square at which a block is left


class BlockPushExpert:
    """A scripted expert for one episode of block pushing.

    What it does follows from the state and from a preference drawn at the start: which block goes first and which square it
    gets, one of four orders, and how fast. It recovers by itself: a block that is pushed out of its square is brought back.

    Args:
        rng: draws order and speed.

    Examples:
        >>> from torchrl_sparse.envs.block_push import BlockPushEnv
        >>> env = BlockPushEnv(seeds=[0])  # doctest: +SKIP
        >>> state = env.reset()["observation", "state"]  # doctest: +SKIP
        >>> BlockPushExpert(np.random.default_rng(0)).command(state.numpy()).shape  # doctest: +SKIP
        (2,)
    """

    noise = 0.004  # m

    def __init__(self, rng: np.random.Generator):
        first, crossed = rng.integers(2, size=2)
        self._order = [(first, first ^ crossed), (1 - first, 1 - first ^ crossed)]
        self._speed, self._push_speed = rng.uniform(*_SPEED), rng.uniform(*_PUSH_SPEED)

    def command(self, state: np.ndarray) -> np.ndarray:
        """Return the shift of the tip's target, f64 [2] in m, in a state [16] of `BlockPushEnv`."""
        state = np.asarray(state, np.float64)
        blocks, tip, squares = state[[[0, 1], [3, 4]]], state[8:10], state[[[10, 11], [13, 14]]]
        block, square = self._next(blocks, squares)
        ahead = _direction(blocks[block], squares[square])
        beside, behind = _beside(ahead, tip - blocks[block]), -ahead @ (tip - blocks[block])
        if abs(beside) < _OFF_LINE and 0 < behind < _BEHIND + 0.01:
            side = np.array([-ahead[1], ahead[0]])
            return self._push_speed * ahead - _STEERING * beside * side
        return self._walk(tip, blocks[block] - _BEHIND * ahead, blocks)

    def _next(self, blocks: np.ndarray, squares: np.ndarray) -> tuple[int, int]:
        """Return the pair to work on: the first in order that is not done, unless the other block is where its push begins."""
        left = [(b, s) for b, s in self._order if np.linalg.norm(blocks[b] - squares[s]) > _HOME]
        for block, square in left:
            begin = blocks[block] - _BEHIND * _direction(blocks[block], squares[square])
            if np.linalg.norm(begin - blocks[1 - block]) > _CLEAR:
                return block, square
        return (left or self._order)[0]

    def _walk(self, tip: np.ndarray, goal: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        """Return a step towards ``goal`` that goes round blocks."""
        gap = goal - tip
        distance = max(float(np.linalg.norm(gap)), 1e-9)
        heading = gap / distance
        for block in sorted(blocks, key=lambda block: -np.linalg.norm(block - tip)):
            heading = _go_round(heading, tip - block, goal - block)
        return heading * min(self._speed, distance)


def _direction(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the unit vector from one point to another, f64 [2]."""
    away = end - start
    return away / max(float(np.linalg.norm(away)), 1e-9)


def _beside(ahead: np.ndarray, offset: np.ndarray) -> float:
    """Return the signed distance of ``offset`` to the line along the unit vector ``ahead``, to its left."""
    return float(ahead[0] * offset[1] - ahead[1] * offset[0])


def _go_round(heading: np.ndarray, offset: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return ``heading``, or a direction round a block if the way to the goal leads too close to it.

    Args:
        heading: unit vector.
        offset: from the block to the tip, m.
        goal: from the block to where the tip wants to be, m.
    """
    clear = min(_CLEAR, 0.9 * float(np.linalg.norm(goal)))
    distance = max(float(np.linalg.norm(offset)), 1e-9)
    if distance > _CLEAR + _MARGIN or _closest(offset, goal) >= clear:
        return heading
    outward = offset / distance
    turn = 1.0 if _beside(outward, goal) > 0 else -1.0
    heading = turn * np.array([-outward[1], outward[0]]) + outward * np.clip(
        (clear - distance) / 0.02, -0.5, 1.0
    )
    return heading / np.linalg.norm(heading)


def _closest(start: np.ndarray, end: np.ndarray) -> float:
    """Return the distance of the segment from ``start`` to ``end`` from the origin."""
    way = end - start
    along = np.clip(-(start @ way) / max(float(way @ way), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + along * way))
