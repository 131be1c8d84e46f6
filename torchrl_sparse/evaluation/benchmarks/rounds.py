"""The episodes of a benchmark: a fixed number per method, or as many as its verdict needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing

from torchrl.envs import EnvBase

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.build import Terms
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.pairs import pair_by_design
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["episode_horizon", "make_design", "play_rounds"]

_ANALYSES = 30  # of a benchmark that goes on until it is decided, at most
_BETWEEN = 10  # episodes from one analysis to the next, at least: each makes its environments again
_UNTIL = ("episodes", "conclusive")


def make_design(until: str, episodes: int, max_episodes: int) -> Design:
    """Return the interim-analysis design of a benchmark.

    Args:
        until: "episodes" for a fixed number, "conclusive" to go on until a method's verdicts are reached.
        episodes: that fixed number.
        max_episodes: cap of the others; part of the design, and so not to be raised once episodes were seen.

    Raises:
        InputError: for another ``until``, or a number below 1.

    >>> make_design("episodes", 400, 1300).ends, make_design("conclusive", 400, 1300).ends[:2]
    ((400,), (43, 86))
    >>> make_design("conclusive", 1, 60).ends
    (10, 20, 30, 40, 50, 60)
    """
    if until not in _UNTIL:
        raise InputError(f"until: expected {' or '.join(_UNTIL)}, got {until!r}")
    if until == "episodes":
        return Design(episodes)
    return Design(max_episodes, max(1, min(_ANALYSES, max_episodes // _BETWEEN)))


def episode_horizon(make_env: Callable[..., EnvBase], seeds: Sequence[int]) -> int:
    """Return the steps after which the environment from `make_env` truncates an episode.

    Args:
        make_env: called as ``make_env(seeds=seeds)``.
        seeds: of all episodes that may be played; an environment may refuse some.
    """
    with closing(make_env(seeds=seeds)) as env:
        return env.base_env.horizon


def play_rounds(
    names: Iterable[str], play: Callable[[str, int], list[EpisodeResult]], terms: Terms
) -> dict[str, list[EpisodeResult]]:
    """Play every method until its verdict is reached or the cap is, and dense as far as the longest of them.

    Nothing but the episodes decides, analysis by analysis, so a benchmark that was killed stops where it would have stopped.

    Args:
        names: of methods, dense among them or not.
        play: called as ``play(name, n)``, returns the method's first n episodes; those that it has are not run again.
        terms: of the comparison.

    Returns:
        name -> its episodes, in the order in which methods were played, dense first.
    """
    design = terms.design
    episodes: dict[str, list[EpisodeResult]] = {DENSE: []}
    for name in names:
        if name == DENSE:
            continue
        for n in design.ends:
            if len(episodes[DENSE]) < n:
                episodes[DENSE] = play(DENSE, n)
            episodes[name] = play(name, n)
            if terms.decided(pair_by_design(name, episodes[name], DENSE, episodes[DENSE], design)):
                break
    if not episodes[DENSE]:
        episodes[DENSE] = play(DENSE, design.max_episodes)
    return episodes
