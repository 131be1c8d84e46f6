"""Operators: the skill of a scripted demonstrator, and the style drawn for each episode.

``proficient`` is one consistent skilled operator, ``mixed`` six of three skills: scripted counterparts of the
proficient-human and multi-human data of robomimic (arXiv:2108.03298). ``recovering`` is the first of them with mishaps in most
episodes: policies that only saw grasps succeed are lost after one that did not. No human took part in any.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from torchrl_sparse.errors import InputError

Range = tuple[float, float]
"""Lower and upper end of a uniform distribution."""


@dataclass(frozen=True)
class Operator:
    """Skill of one operator. Ranges are sampled once per episode; probabilities apply as stated.

    Attributes:
        name: recorded with each demonstration.
        reach: how far ahead of the hand a target lies, m. It sets the speed: about six times it a second.
        turn: the same for rotations, rad.
        hover: height over a goal at which it is approached, m.
        slope: metres of height, up to ``hover``, for each metre of horizontal distance left to the goal.
        bow: sideways offset of a path while the goal is far, m; its sign is drawn too.
        offset: distance of the chosen grasp from the ideal one, m.
        noise: standard deviation of the noise on executed positions, m, far from the goal.
        bump: probability that the hand is pushed away once in an episode.
        slip: probability that the fingers are opened once after a grasp.
        hesitation: probability a step of starting to pause.
        miss: probability that the fingers are closed once short of a grasp, and the hand goes on empty.
    """

    name: str
    reach: Range
    turn: Range
    hover: Range
    slope: Range
    bow: Range
    offset: Range
    noise: float
    bump: float
    slip: float
    hesitation: float
    miss: float = 0.0

    def draw(self, rng: np.random.Generator) -> Style:
        """Sample the style of one episode."""
        sides = rng.choice([-1.0, 1.0], size=2)
        return Style(
            reach=rng.uniform(*self.reach),
            turn=rng.uniform(*self.turn),
            hover=rng.uniform(*self.hover),
            slope=rng.uniform(*self.slope),
            bow=sides[0] * rng.uniform(*self.bow),
            offset=sides[1] * rng.uniform(*self.offset),
        )


@dataclass(frozen=True)
class Style:
    """One episode's sample from an `Operator`: the same quantities and units, now signed numbers."""

    reach: float
    turn: float
    hover: float
    slope: float
    bow: float
    offset: float


def _operator(name: str, speed: float, sloppiness: float, hesitation: float) -> Operator:
    """Return an operator whose paths wander in proportion to ``sloppiness`` (1 is the proficient one)."""
    return Operator(
        name=name,
        reach=(0.85 * 0.07 * speed, 1.15 * 0.07 * speed),
        turn=(0.4 * speed, 0.6 * speed),
        hover=(0.05, 0.07 + 0.03 * sloppiness),
        slope=(2.0, 4.0),
        bow=(0.0, 0.01 * sloppiness),
        offset=(0.0, 0.003 * min(sloppiness, 2.0)),
        noise=0.008 * min(sloppiness, 2.0),
        bump=min(0.15 * sloppiness, 0.5),
        slip=min(0.04 * sloppiness, 0.2),
        hesitation=hesitation,
    )


_PROFICIENT = _operator("proficient", 1.0, 1.0, 0.0)

OPERATORS: Mapping[str, tuple[Operator, ...]] = {
    "proficient": (_PROFICIENT,),
    "recovering": (replace(_PROFICIENT, name="recovering", bump=0.3, slip=0.3, miss=0.8),),
    "mixed": (
        _operator("better_1", 1.0, 1.0, 0.0),
        _operator("better_2", 0.85, 1.5, 0.005),
        _operator("okay_1", 0.7, 2.5, 0.01),
        _operator("okay_2", 0.85, 3.5, 0.015),
        _operator("worse_1", 0.5, 4.0, 0.03),
        _operator("worse_2", 0.6, 5.0, 0.04),
    ),
}
"""Operators of each quality; an episode's is drawn uniformly."""


def draw_operator(quality: str, rng: np.random.Generator) -> Operator:
    """Sample one of the operators of a quality level.

    Raises:
        InputError: if there is no such quality; the message lists those there are.
    """
    if quality not in OPERATORS:
        raise InputError(f"quality: expected one of {', '.join(OPERATORS)}, got {quality!r}")
    operators = OPERATORS[quality]
    return operators[rng.integers(len(operators))]
