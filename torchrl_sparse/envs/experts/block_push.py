"""Scripted expert for block pushing: go behind a block, push it towards its square, then push the other one."""

from __future__ import annotations

import numpy as np

from torchrl_sparse.envs.block_push import TOLERANCE

_SPEED = 0.026  # m per step while walking
_PUSH_SPEED = 0.012  # m per step while pushing
_BEHIND = 0.045  # m from a block's centre, where a push begins
_NEAR = 0.03  # m beyond that, from where on a push is as fast as a walk
_CLEAR = 0.05  # m from a block's centre that a walk keeps; the corner of a block is at 0.028
_ON_LINE = 0.006  # m beside the line of the push, within which a push begins
_OFF_LINE = 0.016  # m beside it, beyond which it ends, to begin again
_ARRIVAL = 0.6  # share of the way left that a walk makes in a step at most
_TURNING = 3.0  # how much a walk turns outwards that comes too close to a block
_STEERING = 1.6  # share of the distance to the line that a step of a push makes good
_HOME = 0.6 * TOLERANCE  # m to its square at which a block is left


class BlockPushExpert:
    """A scripted expert for one episode of block pushing.

    What it does follows from the state, from whether it is pushing, and from a preference drawn at the start: which block goes
    first and which square it gets, one of four orders. It recovers by itself: a block that is pushed out of its square is
    brought back. Its commands jump only where it turns to the other block, begins a push, or ends one that has left its line to
    begin it again: a policy has to learn them.

    Args:
        rng: draws the order.

    Examples:
        >>> from torchrl_sparse.envs.block_push import BlockPushEnv
        >>> env = BlockPushEnv(seeds=[0])  # doctest: +SKIP
        >>> state = env.reset()["observation", "state"]  # doctest: +SKIP
        >>> BlockPushExpert(np.random.default_rng(0)).command(state.numpy()).shape  # doctest: +SKIP
        (2,)
    """

    noise = 0.003  # m

    def __init__(self, rng: np.random.Generator):
        first, crossed = rng.integers(2, size=2)
        self._order = [(first, first ^ crossed), (1 - first, 1 - first ^ crossed)]
        self._working: tuple[int, int] | None = None  # block and square
        self._pushing = False

    def command(self, state: np.ndarray) -> np.ndarray:
        """Return the shift of the tip's target, f64 [2] in m, for a state [16] of `BlockPushEnv`."""
        state = np.asarray(state, np.float64)
        blocks, tip, squares = state[[[0, 1], [3, 4]]], state[8:10], state[[[10, 11], [13, 14]]]
        working = self._next(blocks, squares)
        self._pushing, self._working = self._pushing and working == self._working, working
        block, square = working
        ahead = _direction(blocks[block], squares[square])
        beside, behind = _cross(ahead, tip - blocks[block]), -ahead @ (tip - blocks[block])
        reach, nearest = (_OFF_LINE, 0.0) if self._pushing else (_ON_LINE, _BEHIND - _ON_LINE)
        self._pushing = abs(beside) < reach and behind > nearest
        if not self._pushing:
            return self._walk(tip, blocks[block] - _BEHIND * ahead, blocks)
        pace = _PUSH_SPEED + (_SPEED - _PUSH_SPEED) * np.clip((behind - _BEHIND) / _NEAR, 0, 1)
        return pace * ahead - _STEERING * beside * np.array([-ahead[1], ahead[0]])

    def _next(self, blocks: np.ndarray, squares: np.ndarray) -> tuple[int, int]:
        """Return the pair to work on until it is done: the first in order, unless the other block is where its push begins."""
        left = [(b, s) for b, s in self._order if np.linalg.norm(blocks[b] - squares[s]) > _HOME]
        if self._working in left:
            return self._working
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
        return heading * min(_SPEED, _ARRIVAL * distance)


def _direction(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the unit vector from one point to another, f64 [2]."""
    return _unit(end - start)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _cross(first: np.ndarray, second: np.ndarray) -> float:
    """Return how far ``second`` is to the left of the line along the unit vector ``first``."""
    return float(first[0] * second[1] - first[1] * second[0])


def _go_round(heading: np.ndarray, offset: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return ``heading``, or the tangent to the circle that is kept free round a block, if the way to the goal cuts it.

    On the circle the tangent is square to the way out, and within it the heading turns outwards: all is continuous but where
    both ways round are as long.

    Args:
        heading: unit vector.
        offset: from the block to the tip, m.
        goal: from the block to where the tip wants to be, m.
    """
    clear = min(_CLEAR, 0.9 * float(np.linalg.norm(goal)))
    if _closest(offset, goal) >= clear:
        return heading
    distance = max(float(np.linalg.norm(offset)), 1e-9)
    outward = offset / distance
    turn = 1.0 if _cross(outward, goal) > 0 else -1.0
    side = turn * np.array([-outward[1], outward[0]])
    if distance >= clear:
        sine = clear / distance
        return sine * side - np.sqrt(1 - sine**2) * outward
    onwards = heading if heading @ outward > 0 else side
    return _unit(onwards + _TURNING * (1 - distance / clear) * outward)


def _closest(start: np.ndarray, end: np.ndarray) -> float:
    """Return the distance of the segment from ``start`` to ``end`` from the origin."""
    way = end - start
    along = np.clip(-(start @ way) / max(float(way @ way), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + along * way))
