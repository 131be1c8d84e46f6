"""Scripted expert for Push-T: simulate many straight pushes, execute the best one, repeat."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from torchrl_sparse.envs.extras import import_extra
from torchrl_sparse.envs.pusht import GOAL, KEYPOINTS, WINDOW

_CORNERS = np.array(
    [[-60, 0], [60, 0], [60, 30], [15, 30], [15, 120], [-15, 120], [-15, 30], [-60, 30]], np.float64
)
_CENTER = np.array([0.0, 45.0])  # of mass, in the block's frame
_RADIUS = 15.0  # of the agent, pixels
_GAP = 8.0  # pixels between agent and block where a push begins
_ORBIT = 100.0  # pixels from the block's centre at which the agent goes round it
_ORBIT_STEP = np.pi / 6
_WALL = 24.0  # pixels from the window's edge that the agent keeps
_SPACING = 12.0  # pixels between places of the outline that are tried
_ANGLES = np.radians([-30.0, 0.0, 30.0])  # of a push to the outline's normal
_LENGTHS = np.array([2.0, 4.0, 7.0, 12.0, 20.0, 35.0, 60.0, 90.0])  # pixels that the agent moves the outline
_SPEED = 1.5  # pixels the agent moves in a step of 0.01 s of the copy
# Pixels of the target before the agent: five times that is its speed per second.
_PUSH_LEAD, _WALK_LEAD = 35.0, 90.0
# Pixels at which a point counts as reached: where pushes begin and end, and on the way there.
_AT, _NEAR = 2.0, 15.0
_OVERHEAD = 6.0  # steps that a push costs besides its length


@dataclass(frozen=True)
class _Point:
    """A point to go to, f64 [2] in pixels.

    Attributes:
        lead: how far the agent's target is ahead of it on the way, pixels.
        near: distance at which the point counts as reached, pixels.
    """

    position: np.ndarray
    lead: float = _WALK_LEAD
    near: float = _NEAR


class PushTExpert:
    """A scripted expert for one episode of Push-T.

    It looks one push ahead: straight pushes at places all along the block's outline are simulated, and the one is made that
    brings the outline nearest to the goal for the steps it takes.

    Args:
        rng: draws which places of the outline are tried, and the pace.

    Raises:
        ImportError: without gym-pusht, with the command that installs it.

    Examples:
        >>> from torchrl_sparse.envs.pusht import PushTEnv
        >>> state = PushTEnv(seeds=[0]).reset()["observation", "state"]  # doctest: +SKIP
        >>> PushTExpert(np.random.default_rng(0)).command(state.numpy()).shape  # doctest: +SKIP
        (2,)
    """

    noise = 2.0  # pixels

    def __init__(self, rng: np.random.Generator):
        self._copy = import_extra("gym_pusht.envs.pusht", "pusht").PushTEnv()
        self._copy.reset(seed=0)
        self._rng = rng
        self._pace = rng.uniform(0.85, 1.1)
        self._way: list[_Point] = []

    def command(self, state: np.ndarray) -> np.ndarray:
        """Return the agent's target position, f64 [2] in pixels, for a state [20] of `PushTEnv`."""
        state = np.asarray(state, np.float64)
        agent = state[18:]
        while self._way and np.linalg.norm(self._way[0].position - agent) < self._way[0].near:
            self._way.pop(0)
        if not self._way:
            self._way = self._plan(agent, *block_pose(state[:18].reshape(9, 2)))
        gap = self._way[0].position - agent
        lead = self._pace * self._way[0].lead
        return agent + gap * min(1.0, lead / max(float(np.linalg.norm(gap)), 1e-9))

    def _plan(self, agent: np.ndarray, position: np.ndarray, angle: float) -> list[_Point]:
        """Plan the way to the best push, the push, and the way back."""
        best, best_rate = [_Point(np.full(2, WINDOW / 2))], -np.inf
        before = _error(position, angle)
        for begin, direction in self._candidates(position, angle):
            walk = _walk(agent, begin, position, angle)
            steps = _OVERHEAD + _length([agent, *walk]) / (0.5 * _WALK_LEAD)
            for length, error in self._try(begin, direction, position, angle):
                rate = (before - error) / (steps + length / (0.5 * _PUSH_LEAD))
                if rate > best_rate:
                    end = _Point(begin + (_GAP + length) * direction, _PUSH_LEAD, _AT)
                    way = [*map(_Point, walk[:-1]), _Point(begin, near=_AT), end, _Point(begin)]
                    best, best_rate = way, rate
        return best

    def _candidates(self, position: np.ndarray, angle: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Return the points where pushes may begin, and their unit directions."""
        turn = _rotation(angle)
        for start, end in zip(_CORNERS, np.roll(_CORNERS, -1, axis=0), strict=True):
            edge = end - start
            side = float(np.linalg.norm(edge))
            normal = np.array([edge[1], -edge[0]]) / side
            for along in np.arange(self._rng.uniform(2, _SPACING), side - 2, _SPACING):
                place = start + edge * along / side
                for tilt in _ANGLES:
                    outward = _rotation(tilt) @ normal
                    begin = position + turn @ (place + _RADIUS * normal + _GAP * outward)
                    if (np.abs(begin - WINDOW / 2) < WINDOW / 2 - _WALL).all() and _is_free(
                        begin, position, angle
                    ):
                        yield begin, -turn @ outward

    def _try(
        self, begin: np.ndarray, direction: np.ndarray, position: np.ndarray, angle: float
    ) -> Iterator[tuple[float, float]]:
        """Push in the copy: yield each length and the outline's distance to the goal after it."""
        block, agent, space = self._copy.block, self._copy.agent, self._copy.space
        block.angle, block.position = angle, tuple(position)
        block.velocity, block.angular_velocity = (0.0, 0.0), 0.0
        agent.position, agent.velocity = tuple(begin), tuple(100 * _SPEED * direction)
        space.reindex_shapes_for_body(block)
        space.reindex_shapes_for_body(agent)
        moved = 0.0
        for length in _LENGTHS:
            while moved < _GAP + length:
                space.step(0.01)
                moved += _SPEED
            if (np.abs(np.array(agent.position) - WINDOW / 2) > WINDOW / 2 - _WALL).any():
                return
            yield length, _error(np.array(block.position), block.angle)


def block_pose(keypoints: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the block's position f64 [2], pixels, and angle, rad, from its keypoints [9, 2].

    >>> from torchrl_sparse.envs.pusht import block_keypoints
    >>> position, angle = block_pose(block_keypoints((100.0, 200.0), 0.7))
    >>> position.round(6).tolist(), round(angle, 6)
    ([100.0, 200.0], 0.7)
    """
    own, seen = KEYPOINTS - KEYPOINTS.mean(0), keypoints - keypoints.mean(0)
    angle = float(np.arctan2((own[:, 0] * seen[:, 1] - own[:, 1] * seen[:, 0]).sum(), (own * seen).sum()))
    return keypoints.mean(0) - _rotation(angle) @ KEYPOINTS.mean(0), angle


def _rotation(angle: float) -> np.ndarray:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def _outline(position: np.ndarray, angle: float) -> np.ndarray:
    return position + _CORNERS @ _rotation(angle).T


_GOAL_OUTLINE = _outline(GOAL[:2], GOAL[2])


def _error(position: np.ndarray, angle: float) -> float:
    """Return the mean distance of the outline's corners to where they should be, pixels."""
    return float(np.linalg.norm(_outline(position, angle) - _GOAL_OUTLINE, axis=1).mean())


def _distance(points: np.ndarray, position: np.ndarray, angle: float) -> np.ndarray:
    """Return the distance of points [n, 2] to the block, pixels; 0 inside it."""
    own = (points - position) @ _rotation(angle)
    bar = np.linalg.norm(np.maximum(np.abs(own - [0, 15]) - [60, 15], 0), axis=-1)
    stem = np.linalg.norm(np.maximum(np.abs(own - [0, 75]) - [15, 45], 0), axis=-1)
    return np.minimum(bar, stem)


def _is_free(point: np.ndarray, position: np.ndarray, angle: float) -> bool:
    return bool(_distance(point, position, angle) > _RADIUS + 1)


def _walk(agent: np.ndarray, goal: np.ndarray, position: np.ndarray, angle: float) -> list[np.ndarray]:
    """Return points on a way to ``goal`` that does not touch the block: straight, or out, round and in again."""
    way = agent + np.linspace(0, 1, 20)[:, None] * (goal - agent)
    if (_distance(way[1:], position, angle) > _RADIUS + 2).all():
        return [goal]
    center = position + _rotation(angle) @ _CENTER
    first, last = (np.arctan2(*(point - center)[::-1]) for point in (agent, goal))
    turn = (last - first + np.pi) % (2 * np.pi) - np.pi
    angles = first + turn * np.linspace(0, 1, 1 + max(1, round(abs(turn) / _ORBIT_STEP)))
    orbit = center + _ORBIT * np.stack([np.cos(angles), np.sin(angles)], -1)
    return [*np.clip(orbit, _WALL, WINDOW - _WALL), goal]


def _length(points: list[np.ndarray]) -> float:
    return float(np.linalg.norm(np.diff(np.stack(points), axis=0), axis=1).sum())
