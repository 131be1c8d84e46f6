"""The TorchRL collector that runs episodes in this process, in several, or on a Ray cluster, and which of its workers died."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.envs import EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_sparse.runtime.backends import ray_death

__all__ = ["lost_workers", "start_collector"]

_STEPS_PER_BATCH = 16  # that a worker makes between two reports


def start_collector(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    num_envs: int,
    workers: int,
    backend: str,
    max_steps: int | None,
    policy_device: torch.device | str | None,
) -> BaseCollector:
    """Start a collector without end, and deal the seeds among its environments; see `rollout_episodes`.

    Its batches are [workers, environments, steps] of several processes, else [environments, steps]: of this process or, on
    Ray, of the worker that was ready first.
    """
    workers = min(workers, len(seeds))
    count = min(num_envs, len(seeds) // workers)  # as many in each worker, and none without a seed
    shares = [seeds[index :: workers * count] for index in range(workers * count)]
    make = [
        partial(_batched, make_env, shares[worker * count : (worker + 1) * count], max_steps)
        for worker in range(workers)
    ]
    options = {
        "policy_device": policy_device,
        "storing_device": torch.device("cpu"),
        # The policy's noise is a key, not a distribution; RANDOM keeps any other actor as it was trained.
        "exploration_type": ExplorationType.RANDOM,
    }
    transforms = {"auto_register_policy_transforms": True}
    if backend == "ray":
        return _start_ray(make, actor, count * _STEPS_PER_BATCH, transforms, options)
    options |= transforms | {"total_frames": -1}
    if workers == 1:
        return Collector(make[0](), actor, frames_per_batch=count, **options)
    frames = workers * count * _STEPS_PER_BATCH
    # Without buffers, since words cannot lie in shared memory (tensordict makes arrays of them that no queue takes).
    return MultiSyncCollector(
        make, actor, frames_per_batch=frames, cat_results="stack", use_buffers=False, num_threads=1, **options
    )


def _start_ray(make, actor, frames_per_batch: int, transforms: dict, options: dict) -> BaseCollector:
    from torchrl.collectors.distributed import RayCollector

    return RayCollector(
        make,
        actor,
        frames_per_batch=frames_per_batch,
        total_frames=sys.maxsize,  # -1, endless for other collectors, ends this one before its first batch
        sync=False,
        remote_configs={"num_cpus": 1},
        collector_kwargs=transforms,
        # No weights are sent after the start, and so nothing waits for a worker before the first batch.
        weight_sync_schemes={},
        **options,
    )


def _batched(
    make_env: Callable[..., EnvBase], shares: Sequence[Sequence[int]], max_steps: int | None
) -> EnvBase:
    """Make one environment per share of the seeds, stepped as one batch."""
    # One function with differing arguments, rather than differing functions, lets SerialEnv take its
    # specs from a single throw-away environment instead of one per worker.
    env = SerialEnv(len(shares), make_env, create_env_kwargs=[{"seeds": share} for share in shares])
    return env if max_steps is None else TransformedEnv(env, StepCounter(max_steps))


def lost_workers(collector: BaseCollector, error: Exception) -> str:
    """Name the workers that died of themselves; empty if none did and ``error`` is of another kind."""
    if hasattr(collector, "remote_collectors"):
        return ray_death(error)
    # TorchRL's exception depends on when it notices the death; that a process is dead counts.
    dead = [
        f"worker {index} ended with exit code {process.exitcode}"
        for index, process in enumerate(getattr(collector, "procs", ()))
        # TorchRL terminates and closes those that are alive when it finds a dead one.
        if not process._closed and process.exitcode not in (None, -signal.SIGTERM)
    ]
    return ", ".join(dead)
