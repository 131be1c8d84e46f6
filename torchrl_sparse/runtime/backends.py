"""Backends for workers: processes of this machine, or a Ray cluster. Ray is optional and imported only on demand."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from torchrl_sparse.errors import InputError

__all__ = ["WorkerDied", "backend_runtime", "check_backend", "ray_death"]

_BACKENDS = ("process", "ray")


class WorkerDied(RuntimeError):
    """Error for a worker that was killed or did not start; its unfinished work can be repeated."""


def check_backend(backend: str, workers: int) -> None:
    """Raise InputError for an unknown backend or fewer than one worker."""
    if backend not in _BACKENDS:
        raise InputError(f"backend: expected one of {', '.join(_BACKENDS)}, got {backend!r}")
    if workers < 1:
        raise InputError(f"workers: expected at least 1, got {workers}")


def backend_runtime(backend: str, workers: int) -> AbstractContextManager[None]:
    """Return a context for ``workers``: nothing for processes, a cluster for Ray.

    A cluster that this process is connected to, or that the variable ``RAY_ADDRESS`` names ("auto" for one that ``ray start``
    made on this machine), is used and left running. Otherwise a local one of ``workers`` CPUs lives as long as the block.

    Raises:
        InputError: see `check_backend`.
        ImportError: if Ray is asked for and not installed.

    >>> with backend_runtime("process", workers=2):
    ...     pass
    """
    check_backend(backend, workers)
    return _ray_runtime(workers) if backend == "ray" else nullcontext()


@contextmanager
def _ray_runtime(workers: int) -> Iterator[None]:
    ray = _import_ray()
    with warnings.catch_warnings():
        # Nothing is trained here: each worker keeps the weights that it was made with.
        warnings.filterwarnings("ignore", message="RayCollector iteration started before weight sync")
        if ray.is_initialized():
            yield
            return
        options = {"log_to_driver": False, "logging_level": logging.WARNING}
        if "RAY_ADDRESS" in os.environ:
            ray.init(**options)
        else:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, **options)
        try:
            yield
        finally:
            ray.shutdown()


def ray_death(error: BaseException) -> str:
    """Say which Ray worker died; empty if ``error`` has another cause, such as an exception in a worker's task."""
    errors = _import_ray().exceptions
    deaths = (
        errors.RayActorError,
        errors.WorkerCrashedError,
        errors.NodeDiedError,
        errors.OutOfMemoryError,
    )
    # An exception in an actor's constructor would come again with the next actor.
    if not isinstance(error, deaths) or getattr(error, "actor_init_failed", False):
        return ""
    return f"a Ray worker died: {' '.join(str(error).split())}"


def _import_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ImportError("backend: 'ray' needs Ray: pip install 'torchrl-sparse[ray]'") from error
    return ray
