"""Evaluation of one method: its episodes, with a resumable log and a progress bar."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.runtime.progress import progress

__all__ = ["episode_log", "evaluate", "success_rate"]


def evaluate(
    name: str,
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    log: str | os.PathLike | None = None,
    identity: Mapping[str, Any] | None = None,
    **options: Any,
) -> list[EpisodeResult]:
    """Run one episode per seed and show a progress bar.

    Args:
        name: of the method, for the bar.
        actor, make_env, seeds: see `rollout_episodes`.
        log: JSON-lines file that every finished episode is appended to; those that are in it already are not run again.
        identity: what makes these episodes this method's own; a log with another identity is refused.
        options: others of `rollout_episodes`, such as ``num_envs``, ``workers`` and ``backend``.

    Returns:
        The episodes in the order of ``seeds``.

    Raises:
        As `rollout_episodes`.
    """
    with progress(name, "episode", len(seeds)) as show:
        return rollout_episodes(
            actor,
            make_env,
            seeds,
            results_file=log,
            identity=identity,
            on_episode=lambda _, done, total: show(done, total),
            **options,
        )


def success_rate(episodes: Sequence[EpisodeResult]) -> float:
    """Return the share of episodes that succeeded.

    >>> success_rate([EpisodeResult(0, True, 8, 1, 10.0, 0.5), EpisodeResult(1, False, 24, 3, 90.0, 0.9)])
    0.5
    """
    return sum(episode.success for episode in episodes) / len(episodes)


def episode_log(out: str | os.PathLike, name: str, dense_log: str | os.PathLike | None = None) -> Path:
    """Return the path of a method's log in the folder ``out``; for ``"dense"``, ``dense_log`` if it is given.

    >>> episode_log("outputs/lift", "bac").as_posix()
    'outputs/lift/episodes/bac.jsonl'
    """
    if name == "dense" and dense_log is not None:
        return Path(dense_log)
    return Path(out) / "episodes" / f"{name}.jsonl"
