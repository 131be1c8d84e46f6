"""Parallel demonstration workers whose results are returned in the order of the seeds.

An expert reads the simulator and not the TensorDict, so these are plain processes, or plain Ray tasks, rather than a TorchRL
collector.
"""

from __future__ import annotations

import os
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import count
from multiprocessing import get_context, parent_process
from typing import Any

from torchrl_sparse.runtime.backends import backend_runtime, ray_death
from torchrl_sparse.runtime.failure import RunFailed

__all__ = ["in_order"]

_AHEAD = 2  # tasks per worker that are handed out beyond the one waited for
_FAILURES = 3


def in_order(
    task: Callable[[int], object], first: int, workers: int, *, backend: str = "process"
) -> Generator[int, None, None]:
    """Call ``task(first)``, ``task(first + 1)``, ... in workers and yield each number, in order, once it is done.

    A worker that dies, be it while it starts, is reported as a warning; what it and the others had under way is done again.

    Args:
        task: picklable; calling it again for the same number must do no harm.
        first: the first number.
        workers: processes, or CPUs of Ray's.
        backend: "process" or "ray", see `backend_runtime`.

    Raises:
        InputError: for an unknown backend.
        ImportError: if Ray is asked for and not installed.
        RunFailed: if workers die three times in a row without anything done between.
        Exception: whatever ``task`` raises.

    >>> numbers = in_order(abs, 3, workers=1)
    >>> next(numbers), next(numbers)
    (3, 4)
    >>> numbers.close()
    """
    failures = 0
    with backend_runtime(backend, workers):
        while True:
            pool = _pool(backend, workers)
            ahead: deque[Future] = deque()
            try:
                numbers = count(first)
                while True:
                    while len(ahead) < _AHEAD * workers:
                        ahead.append(_submit(pool, task, next(numbers)))
                    ahead.popleft().result()
                    failures, first = 0, first + 1
                    yield first - 1
            except Exception as error:
                death = _death(backend, error)
                if not death:
                    raise
                failures += 1
                if failures == _FAILURES:
                    raise RunFailed(
                        f"workers died {failures} times in a row at number {first}: {death}"
                    ) from error
                warnings.warn(f"{death}; going on from number {first}", RuntimeWarning, stacklevel=2)
            finally:
                pool.shutdown(cancel_futures=True)


def _pool(backend: str, workers: int) -> Executor:
    if backend == "ray":
        return _RayPool()
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin_worker)


def _submit(pool: Executor, task: Callable[[int], object], number: int) -> Future:
    try:
        return pool.submit(task, number)
    except OSError:
        # A worker died while the next was started, and the pool closed what that was to be given. Asked again it says so.
        return pool.submit(task, number)


def _begin_worker() -> None:
    """An interrupt ends a worker as a kill does, instead of as an error of its task; so does the end of its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    # Without it a worker whose parent was killed waits for tasks for ever: it holds both ends of the queue's pipe.
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _death(backend: str, error: Exception) -> str:
    """Name what died; empty if it is the task that raised ``error``."""
    if backend == "ray":
        return ray_death(error)
    return "a worker died" if isinstance(error, BrokenProcessPool) else ""


class _RayPool(Executor):
    """Ray tasks of one CPU each as futures. Ray's own silent retries are off: a death has to be reported."""

    def __init__(self) -> None:
        import ray

        self._call = ray.remote(num_cpus=1, max_retries=0)(_call)
        self._open: set[Any] = set()

    def submit(self, task: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Hand a task out."""
        reference = self._call.remote(task, *args, **kwargs)
        self._open.add(reference)
        future = reference.future()
        future.add_done_callback(lambda _: self._open.discard(reference))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Interrupt what is under way and wait until it has ended."""
        import ray

        running = list(self._open)
        for reference in running:
            ray.cancel(reference)
        if running:
            ray.wait(running, num_returns=len(running))


def _call(task: Callable[[int], object], number: int) -> None:
    task(number)
