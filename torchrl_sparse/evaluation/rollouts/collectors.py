"""The TorchRL collector that runs episodes in this process, in several, or on a Ray cluster, and reports dead workers."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_sparse.evaluation.rollouts.process_collector import START_LIMIT, in_processes, time_limit
from torchrl_sparse.runtime.backends import WorkerDied, ray_death

__all__ = ["running_collector"]

# Between two reports: each takes time, and what was not reported when a kill came runs again.
_STEPS_PER_BATCH = 16


@contextmanager
def running_collector(
    actor: TensorDictModuleBase,
    make_env: Callable[..., EnvBase],
    seeds: Sequence[int],
    *,
    num_envs: int,
    workers: int,
    backend: str,
    max_steps: int | None,
    policy_device: torch.device | str | None,
) -> Iterator[BaseCollector]:
    """Run an endless collector during the block and distribute the seeds over its environments; see `rollout_episodes`.

    Its batches are [environments, steps], of one environment [steps]: of this process, else of the worker that was ready first.

    Raises:
        WorkerDied: if a worker dies, while it starts or in the block, or has not started after ten minutes.
        Exception: what a worker raised while it started (on Ray within a RayActorError) or, on Ray, later.
        RuntimeError: if a worker process raised something later; its traceback is on stderr.
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
    options["frames_per_batch"] = count * _STEPS_PER_BATCH
    transforms = {"auto_register_policy_transforms": True}
    if backend == "ray":
        running = _on_ray(make, actor, collector_kwargs=transforms, **options)
    elif workers == 1:
        running = _here(make[0](), actor, **transforms, **options)
    else:
        running = in_processes(make, actor, **transforms, **options)
    with running as collector:
        yield collector


@contextmanager
def _here(env: EnvBase, actor: TensorDictModuleBase, **options: Any) -> Iterator[BaseCollector]:
    collector = Collector(env, actor, total_frames=-1, **options)
    try:
        yield collector
    finally:
        collector.shutdown()


@contextmanager
def _on_ray(
    make: Sequence[Callable[[], EnvBase]], actor: TensorDictModuleBase, **options: Any
) -> Iterator[BaseCollector]:
    from torchrl.collectors.distributed import RayCollector

    collector = RayCollector.__new__(RayCollector)  # to be at hand while it waits for its workers
    try:
        with time_limit(START_LIMIT, collector.stop_remote_collectors):
            collector.__init__(
                list(make),
                actor,
                total_frames=sys.maxsize,  # -1, endless for other collectors, ends this one before its first batch
                sync=False,
                remote_configs={"num_cpus": 1},
                collector_class=_RayWorker,
                weight_sync_schemes={},  # no weights are sent after the start
                **options,
            )
        yield collector
    except Exception as error:
        if lost := ray_death(error):
            raise WorkerDied(lost) from error
        raise getattr(error, "cause", error) from error  # Ray wraps what a worker raised
    finally:
        collector.shutdown()


class _RayWorker(Collector):
    """A collector that Ray can ask whether it is true: it does so when the collector raises something.

    Without end a collector's length is infinite, of which Python makes an error, and Ray a death of the worker.
    """

    def __bool__(self) -> bool:
        return True


def _batched(
    make_env: Callable[..., EnvBase], shares: Sequence[Sequence[int]], max_steps: int | None
) -> EnvBase:
    """Make one environment per share of the seeds, stepped as one batch; a single one as it is, which saves copies."""
    if len(shares) == 1:
        env = make_env(seeds=shares[0])
    else:
        # One function with differing arguments, rather than differing functions, lets SerialEnv take its
        # specs from a single throw-away environment instead of one per worker.
        env = SerialEnv(len(shares), make_env, create_env_kwargs=[{"seeds": share} for share in shares])
    return env if max_steps is None else TransformedEnv(env, StepCounter(max_steps), auto_unwrap=True)
