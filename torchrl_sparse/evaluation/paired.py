"""Paired rollouts: every method on the same initial states and the same noise.

An episode is fixed by its seed, and the noise of a query by (episode seed, episode step). So methods are
paired by running each on the same seeds, in whatever order, number of environments or number of restarts.
"""

import os
import signal
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_sparse import keys
from torchrl_sparse.evaluation.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.latency import num_threads

__all__ = ["rollout_episodes"]

_STEPS_PER_BATCH = 16  # that worker processes make between two reports
_FAILURES = 3  # crashes of workers in a row, without an episode finished between them, that end an evaluation
_REQUIRED = (keys.EPISODE_SEED, keys.QUERIED, keys.FLOPS, ("next", keys.SUCCESS), ("next", "done"))


def rollout_episodes(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    num_envs: int = 10,
    workers: int = 1,
    max_steps: int | None = None,
    results_file: str | os.PathLike | None = None,
    identity: Mapping[str, Any] | None = None,
    on_episode: Callable[[EpisodeResult, int, int], None] | None = None,
    policy_device: torch.device | str | None = None,
) -> list[EpisodeResult]:
    """Run one episode per seed in a TorchRL ``Collector`` over a ``SerialEnv``, or several of them in processes.

    Seeds are dealt to the environments in turn. An environment that has done its own keeps stepping until the last
    one is finished (its surplus episodes are dropped). With ``workers`` > 1 a ``MultiSyncCollector`` runs as many
    processes, each with a copy of the actor. A worker that dies is reported as a warning, and the episodes that were
    under way run again: they come out the same, since nothing but its seed fixes an episode.

    Args:
        actor: writes ``"action"``, ``("control", "queried")`` and ``("cost", "flops")``; ``("cost",
            "latency")`` and ``("diffusion", "prune_mask")`` are recorded where it writes them.
        make_env: called as ``make_env(seeds=[...])``; makes one environment whose episodes take these in
            turn and report them under ``("episode", "seed")``, with ``("next", "success")``.
        seeds: one episode each, all different.
        num_envs: environments stepped as one batch, in each worker.
        workers: processes; 1 runs in this one. With more, ``actor`` and ``make_env`` must be picklable.
        max_steps: truncates an episode, environment steps; None leaves it to the environment's own horizon.
        results_file: JSON-lines file that every finished episode is appended to at once. If it exists, the
            episodes in it are taken over and only the missing seeds run.
        identity: what the file's episodes belong to, see :class:`EpisodeLog`; ``max_steps`` is added to it.
        on_episode: called as ``on_episode(result, done, total)`` after each new episode.
        policy_device: where the actor runs, if not where the environments are.

    Returns:
        The episodes in the order of ``seeds``.

    Raises:
        ValueError: if seeds repeat, a count is out of range or the file belongs to something else.
        KeyError: if the actor or the environment leaves out a key that is needed.
        RuntimeError: if workers keep dying without finishing an episode.

    >>> from torchrl_sparse.envs import make_env                                      # doctest: +SKIP
    >>> rollout_episodes(actor, lambda seeds: make_env("Lift", seeds=seeds), range(100),
    ...                  results_file="dense.jsonl", identity={"method": "dense"})    # doctest: +SKIP
    """
    seeds = [int(seed) for seed in seeds]
    if len(set(seeds)) != len(seeds):
        raise ValueError(f"seeds: expected different ones, got {len(seeds) - len(set(seeds))} repeated")
    if num_envs < 1 or (max_steps is not None and max_steps < 1):
        raise ValueError(f"expected num_envs >= 1 and max_steps >= 1 or None, got {num_envs}, {max_steps}")
    if workers < 1:
        raise ValueError(f"expected workers >= 1, got {workers}")
    log = None
    finished: dict[int, EpisodeResult] = {}
    if results_file is not None:
        log = EpisodeLog(results_file, {**(identity or {}), "max_steps": max_steps})
        finished.update(log.episodes)
    pending = [seed for seed in seeds if seed not in finished]
    start = partial(_start, actor, make_env, num_envs, workers, max_steps, policy_device)
    # TorchRL's collectors and batched environments change PyTorch's thread count when they close.
    with num_threads(None), closing(_episodes(start, pending)) as episodes:
        for episode in episodes:
            finished[episode.seed] = episode
            if log is not None:
                log.append(episode)
            if on_episode is not None:
                on_episode(episode, sum(seed in finished for seed in seeds), len(seeds))
    return [finished[seed] for seed in seeds]


def _episodes(
    start: Callable[[Sequence[int]], Collector | MultiSyncCollector], seeds: Sequence[int]
) -> Iterator[EpisodeResult]:
    """The episode of each seed, as it ends; a collector whose worker dies is replaced by a new one for what is left."""
    pending, failures = list(seeds), 0
    while pending:
        collector = start(pending)
        try:
            for episode in _finished(collector, set(pending)):
                pending.remove(episode.seed)
                failures = 0
                yield episode
        except Exception as error:
            # What TorchRL raises when a worker dies depends on when it notices; that one did is what counts.
            lost, failures = _lost(collector), failures + 1
            if not lost:
                raise
            if failures == _FAILURES:
                raise RuntimeError(f"{lost}, {failures} times without an episode finished between") from error
            warnings.warn(f"{lost}; {len(pending)} episodes are run anew", RuntimeWarning, stacklevel=3)
        finally:
            collector.shutdown()


def _lost(collector: Collector | MultiSyncCollector) -> str:
    """Which worker died of itself, in words; empty if none did."""
    dead = [
        f"worker {index} ended with exit code {process.exitcode}"
        for index, process in enumerate(getattr(collector, "procs", ()))
        # TorchRL terminates and closes those that are alive when it finds a dead one.
        if not process._closed and process.exitcode not in (None, -signal.SIGTERM)
    ]
    return ", ".join(dead)


def _start(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    num_envs: int,
    workers: int,
    max_steps: int | None,
    policy_device: torch.device | str | None,
    seeds: Sequence[int],
) -> Collector | MultiSyncCollector:
    workers = min(workers, len(seeds))
    count = min(num_envs, len(seeds) // workers)  # as many in each worker, and none without a seed
    shares = [seeds[index :: workers * count] for index in range(workers * count)]
    make = [
        partial(_batched, make_env, shares[worker * count : (worker + 1) * count], max_steps)
        for worker in range(workers)
    ]
    options = {
        "total_frames": -1,
        "policy_device": policy_device,
        "storing_device": torch.device("cpu"),
        # The policy's noise is a key, not a distribution; RANDOM keeps any other actor as it was trained.
        "exploration_type": ExplorationType.RANDOM,
        "auto_register_policy_transforms": True,
    }
    if workers == 1:
        return Collector(make[0](), actor, frames_per_batch=count, **options)
    return MultiSyncCollector(
        make,
        actor,
        frames_per_batch=workers * count * _STEPS_PER_BATCH,
        cat_results=0,
        num_threads=1,
        **options,
    )


def _batched(
    make_env: Callable[..., EnvBase], shares: Sequence[Sequence[int]], max_steps: int | None
) -> EnvBase:
    """One environment per share of the seeds, stepped as one batch."""
    # One function with differing arguments, rather than differing functions, lets SerialEnv take its
    # specs from a single throw-away environment instead of one per worker.
    env = SerialEnv(len(shares), make_env, create_env_kwargs=[{"seeds": share} for share in shares])
    return env if max_steps is None else TransformedEnv(env, StepCounter(max_steps))


def _finished(collector: Collector | MultiSyncCollector, pending: set[int]) -> Iterator[EpisodeResult]:
    """Each pending seed's episode as it ends. The seed of a row says which episode it belongs to."""
    running: dict[int, _OpenEpisode] = {}
    for batch in collector:
        for step in batch.unbind(1):
            _check_keys(step)
            for row in step.unbind(0):
                seed = int(row[keys.EPISODE_SEED])
                if seed not in pending:
                    continue
                running.setdefault(seed, _OpenEpisode()).add(row)
                if row["next", "done"].item():
                    pending.remove(seed)
                    yield running.pop(seed).close(seed)
        if not pending:
            return


def _check_keys(step: TensorDictBase) -> None:
    missing = [key for key in _REQUIRED if step.get(key, None) is None]
    if missing:
        raise KeyError(f"a rollout needs the keys {list(_REQUIRED)}, got none of {missing}")


class _OpenEpisode:
    """Sums over the steps of an episode that has not ended yet."""

    def __init__(self) -> None:
        self.length = 0
        self.success = False
        self.flops = 0.0
        self.prune_rates: list[float] = []
        self.latency: list[float] = []
        self.queries = 0

    def add(self, row: TensorDictBase) -> None:
        """Count one step; its cost counts only if it called the policy."""
        self.length += 1
        self.success |= bool(row["next", keys.SUCCESS])
        if not row[keys.QUERIED].item():
            return
        self.queries += 1
        self.flops += float(row[keys.FLOPS])
        mask, latency = row.get(keys.PRUNE_MASK, None), row.get(keys.LATENCY, None)
        self.prune_rates.append(0.0 if mask is None else float(mask.float().mean()))
        if latency is not None:
            self.latency.append(float(latency))

    def close(self, seed: int) -> EpisodeResult:
        """The finished episode."""
        prune_rate = sum(self.prune_rates) / max(self.queries, 1)
        return EpisodeResult(
            seed, self.success, self.length, self.queries, self.flops, prune_rate, tuple(self.latency)
        )
