"""Paired rollouts: every method on the same initial states and the same noise.

An episode is fixed by its seed, and the noise of a query by (episode seed, episode step). So methods are
paired by running each on the same seeds, in whatever order, number of environments or number of restarts.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_sparse import keys
from torchrl_sparse.evaluation.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.latency import num_threads

__all__ = ["rollout_episodes"]

_REQUIRED = (keys.EPISODE_SEED, keys.QUERIED, keys.FLOPS, ("next", keys.SUCCESS), ("next", "done"))


def rollout_episodes(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    num_envs: int = 10,
    max_steps: int | None = None,
    results_file: str | os.PathLike | None = None,
    identity: Mapping[str, Any] | None = None,
    on_episode: Callable[[EpisodeResult, int, int], None] | None = None,
    policy_device: torch.device | str | None = None,
) -> list[EpisodeResult]:
    """Run one episode per seed in a TorchRL ``Collector`` over a ``SerialEnv``.

    Worker ``w`` of the environments gets ``seeds[w::num_envs]``. A worker that has done its seeds keeps
    stepping until the last one is finished (its surplus episodes are dropped).

    Args:
        actor: writes ``"action"``, ``("control", "queried")`` and ``("cost", "flops")``; ``("cost",
            "latency")`` and ``("diffusion", "prune_mask")`` are recorded where it writes them.
        make_env: called as ``make_env(seeds=[...])``; makes one environment whose episodes take these in
            turn and report them under ``("episode", "seed")``, with ``("next", "success")``.
        seeds: one episode each, all different.
        num_envs: environments stepped as one batch.
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

    >>> from torchrl_sparse.envs import make_env                                      # doctest: +SKIP
    >>> rollout_episodes(actor, lambda seeds: make_env("Lift", seeds=seeds), range(100),
    ...                  results_file="dense.jsonl", identity={"method": "dense"})    # doctest: +SKIP
    """
    seeds = [int(seed) for seed in seeds]
    if len(set(seeds)) != len(seeds):
        raise ValueError(f"seeds: expected different ones, got {len(seeds) - len(set(seeds))} repeated")
    if num_envs < 1 or (max_steps is not None and max_steps < 1):
        raise ValueError(f"expected num_envs >= 1 and max_steps >= 1 or None, got {num_envs}, {max_steps}")
    log = None
    finished: dict[int, EpisodeResult] = {}
    if results_file is not None:
        log = EpisodeLog(results_file, {**(identity or {}), "max_steps": max_steps})
        finished.update(log.episodes)
    pending = [seed for seed in seeds if seed not in finished]
    if pending:
        count = min(num_envs, len(pending))
        # TorchRL's batched environments raise PyTorch's thread count when they close: put the caller's back.
        with (
            num_threads(None),
            closing(_Rollout(actor, make_env, pending, count, max_steps, policy_device)) as rollout,
        ):
            for episode in rollout.episodes():
                finished[episode.seed] = episode
                if log is not None:
                    log.append(episode)
                if on_episode is not None:
                    on_episode(episode, sum(seed in finished for seed in seeds), len(seeds))
    return [finished[seed] for seed in seeds]


class _Rollout:
    """A collector and the unfinished episode of each of its environments."""

    def __init__(self, actor, make_env, seeds, num_envs, max_steps, policy_device) -> None:
        self._pending = set(seeds)
        self._open = [_OpenEpisode() for _ in range(num_envs)]
        # One function with differing arguments, rather than differing functions, lets SerialEnv take its
        # specs from a single throw-away environment instead of one per worker.
        env = SerialEnv(
            num_envs,
            make_env,
            create_env_kwargs=[{"seeds": seeds[worker::num_envs]} for worker in range(num_envs)],
        )
        if max_steps is not None:
            env = TransformedEnv(env, StepCounter(max_steps))
        self._collector = Collector(
            env,
            actor,
            frames_per_batch=num_envs,
            total_frames=-1,
            policy_device=policy_device,
            storing_device=torch.device("cpu"),
            # The policy's noise is a key, not a distribution; RANDOM keeps any other actor as it was trained.
            exploration_type=ExplorationType.RANDOM,
            auto_register_policy_transforms=True,
        )

    def episodes(self):
        """Yield each pending seed's episode as it ends."""
        for batch in self._collector:
            step = batch[:, 0]
            self._check_keys(step)
            for worker, row in enumerate(step.unbind(0)):
                episode = self._open[worker]
                episode.add(row)
                if not row["next", "done"].item():
                    continue
                self._open[worker] = _OpenEpisode()
                seed = int(row[keys.EPISODE_SEED])
                if seed in self._pending:
                    self._pending.remove(seed)
                    yield episode.close(seed)
            if not self._pending:
                return

    def close(self) -> None:
        """Shut the collector and its environments down."""
        self._collector.shutdown()

    @staticmethod
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
