"""Paired rollouts: every method on the same initial states and the same noise.

An episode is fixed by its seed, and the noise of a policy call by (episode seed, episode step). So methods are
paired by running each on the same seeds, in whatever order, number of environments or number of restarts.
"""

import math
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.envs.seeds import whole_seed
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.rollouts.collectors import running_collector
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.runtime.backends import WorkerDied, backend_runtime
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["rollout_episodes"]

_FAILURES = 3  # crashes of workers in a row, without an episode finished between them, that end an evaluation
_REQUIRED = (
    keys.EPISODE_SEED,
    keys.QUERIED,
    keys.FLOPS,
    ("next", keys.SUCCESS),
    ("next", "reward"),
    ("next", "done"),
)
_OPTIONAL = (
    keys.LATENCY,
    keys.KEPT,
    keys.FINE,
    keys.PRUNE_MASK,
    keys.TOKEN_DEPTH,
    ("next", keys.EPISODE_COMPLETED),
    ("next", keys.EPISODE_WAY),
)


def rollout_episodes(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    num_envs: int = 10,
    workers: int = 1,
    backend: str = "process",
    max_steps: int | None = None,
    results_file: str | os.PathLike | None = None,
    identity: Mapping[str, Any] | None = None,
    on_episode: Callable[[EpisodeResult, int, int], None] | None = None,
    policy_device: torch.device | str | None = None,
) -> list[EpisodeResult]:
    """Run one episode per seed in a TorchRL ``Collector``, in this process or in several.

    Several environments of one collector are a ``SerialEnv``. Seeds are dealt to the environments in turn. An environment that
    has done its own keeps stepping until the last one is finished (its surplus episodes are dropped). With ``workers`` > 1 a
    ``MultiAsyncCollector`` runs as many processes, and with ``backend="ray"`` a ``RayCollector`` as many Ray actors of one CPU,
    each with a copy of the actor.
    A worker that dies, be it while it starts, is reported as a warning, and the episodes that were under way run again: they
    come out the same, since nothing but its seed fixes an episode. Nothing but rounding, that is: PyTorch sums in another
    order on several threads. The native engine does not, so with it one process equals many whatever its number of threads.

    Args:
        actor: writes ``"action"``, ``("control", "queried")`` and ``("cost", "flops")``; ``("cost",
            "latency")``, ``("diffusion", "prune_mask")``, ``("tokens", "kept")`` and ``("control", "fine")`` are recorded
            where it writes them.
        make_env: called as ``make_env(seeds=[...])``; makes one environment whose episodes take these in
            turn and report them under ``("episode", "seed")``, with ``("next", "success")``.
        seeds: one episode each, all different.
        num_envs: environments stepped as one batch, in each worker.
        workers: how many run episodes at a time, each on one thread. One process is this one, with its own number of
            threads; more, and any on Ray, need an ``actor`` and a ``make_env`` that can be pickled.
        backend: "process" or "ray"; see `backend_runtime` for which Ray that is.
        max_steps: truncates an episode, environment steps; None leaves it to the environment's own horizon.
        results_file: JSON-lines file that every finished episode is appended to at once. If it exists, the
            episodes in it are taken over and only the missing seeds run.
        identity: what the file's episodes belong to, see :class:`EpisodeLog`; ``max_steps`` is added to it.
        on_episode: called as ``on_episode(result, done, total)`` after each new episode.
        policy_device: where the actor runs, if not where the environments are.

    Returns:
        The episodes in the order of ``seeds``.

    Raises:
        InputError: if seeds repeat or are no whole numbers, an option is out of range or the file belongs to something else.
        ImportError: if Ray is asked for and not installed.
        KeyError: if the actor or the environment leaves out a key that is needed.
        RunFailed: if workers keep dying without finishing an episode.
        RuntimeError: if one raised an error.

    Examples:
        >>> from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, make_env
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddim", 2)
        >>> make = partial(make_env, "Lift", horizon=12)
        >>> [episode.queries for episode in rollout_episodes(ChunkExecutor(policy), make, [100_000, 100_001], num_envs=2)]
        [2, 2]
    """
    seeds = [whole_seed(seed) for seed in seeds]
    if len(set(seeds)) != len(seeds):
        raise InputError(f"seeds: expected different ones, got {len(seeds) - len(set(seeds))} repeated")
    if num_envs < 1 or (max_steps is not None and max_steps < 1):
        raise InputError(
            f"num_envs, max_steps: expected at least 1, or no max_steps, got {num_envs}, {max_steps}"
        )
    runtime = backend_runtime(backend, workers)
    log = None
    finished: dict[int, EpisodeResult] = {}
    if results_file is not None:
        log = EpisodeLog(results_file, {**(identity or {}), "max_steps": max_steps})
        finished.update(log.episodes)
    pending = [seed for seed in seeds if seed not in finished]
    run = partial(
        running_collector,
        actor,
        make_env,
        num_envs=num_envs,
        workers=workers,
        backend=backend,
        max_steps=max_steps,
        policy_device=policy_device,
    )
    # TorchRL's collectors and batched environments change PyTorch's thread count when they close.
    with (
        runtime if pending else nullcontext(),
        num_threads(None),
        closing(_episodes(run, pending)) as episodes,
    ):
        for episode in episodes:
            finished[episode.seed] = episode
            if log is not None:
                log.append(episode)
            if on_episode is not None:
                on_episode(episode, sum(seed in finished for seed in seeds), len(seeds))
    return [finished[seed] for seed in seeds]


def _episodes(
    run: Callable[[Sequence[int]], AbstractContextManager[BaseCollector]], seeds: Sequence[int]
) -> Iterator[EpisodeResult]:
    """Yield the episode of each seed as it ends; a collector whose worker dies is replaced by a new one for what is left."""
    pending, failures = list(seeds), 0
    while pending:
        try:
            with run(pending) as collector:
                for episode in _finished(collector, set(pending)):
                    pending.remove(episode.seed)
                    failures = 0
                    yield episode
        except WorkerDied as death:
            failures += 1
            if failures == _FAILURES:
                raise RunFailed(f"{death}, {failures} times without an episode finished between") from death
            warnings.warn(f"{death}; {len(pending)} episodes are run again", RuntimeWarning, stacklevel=3)


def _finished(collector: BaseCollector, pending: set[int]) -> Iterator[EpisodeResult]:
    """Yield each pending seed's episode as it ends. The seed of a row says which episode it belongs to."""
    running: dict[int, _OpenEpisode] = {}
    for batch in collector:
        _check_keys(batch)
        for step in batch.select(*_REQUIRED, *_OPTIONAL, strict=False).unbind(-1):
            for row in step.reshape(-1).unbind(0):
                seed = int(row[keys.EPISODE_SEED])
                if seed not in pending:
                    continue
                running.setdefault(seed, _OpenEpisode()).add(row)
                if row["next", "done"].item():
                    pending.remove(seed)
                    yield running.pop(seed).close(seed)
        if not pending:
            return


def _check_keys(batch: TensorDictBase) -> None:
    missing = [key for key in _REQUIRED if batch.get(key, None) is None]
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
        self.kept: list[float] = []
        self.fine: list[bool] = []
        self.queries = 0
        self.score = -math.inf
        self.completed: int | None = None
        self.way: int | None = None

    def add(self, row: TensorDictBase) -> None:
        """Count one step; its cost counts only if it called the policy."""
        self.length += 1
        self.success |= bool(row["next", keys.SUCCESS])
        self.score = max(self.score, float(row["next", "reward"]))
        self.completed, self.way = _count(row, keys.EPISODE_COMPLETED), _count(row, keys.EPISODE_WAY)
        if not row[keys.QUERIED].item():
            return
        self.queries += 1
        self.flops += float(row[keys.FLOPS])
        self.prune_rates.append(_prune_rate(row))
        for key, values in ((keys.LATENCY, self.latency), (keys.KEPT, self.kept), (keys.FINE, self.fine)):
            if (value := row.get(key, None)) is not None:
                values.append(value.item())

    def close(self, seed: int) -> EpisodeResult:
        """Return the finished episode."""
        return EpisodeResult(
            seed,
            self.success,
            self.length,
            self.queries,
            self.flops,
            prune_rate=sum(self.prune_rates) / max(self.queries, 1),
            latency=tuple(self.latency),
            kept=tuple(self.kept),
            fine=tuple(self.fine),
            score=self.score,
            completed=self.completed,
            way=self.way,
        )


def _count(row: TensorDictBase, key: NestedKey) -> int | None:
    """Return a count of the environment at the end of a step, None where it keeps none."""
    value = row["next"].get(key, None)
    return None if value is None else int(value)


def _prune_rate(row: TensorDictBase) -> float:
    """Return the pruned share of a policy call's blocks or, where there are visual tokens, of those; else 0."""
    if (mask := row.get(keys.PRUNE_MASK, None)) is not None:
        return float(mask.float().mean())
    if (kept := row.get(keys.KEPT, None)) is not None:
        return 1 - kept.item() / row[keys.TOKEN_DEPTH].shape[-1]
    return 0.0
