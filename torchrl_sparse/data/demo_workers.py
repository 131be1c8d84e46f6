"""Demonstrations made by several processes, handed on in the order of their seeds.

An expert reads the simulator and not the TensorDict, so these are plain processes rather than a TorchRL collector.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import count
from multiprocessing import get_context

__all__ = ["in_order"]

_AHEAD = 2  # tasks per worker that are handed out beyond the one waited for
_FAILURES = 3


def in_order(task: Callable[[int], None], first: int, workers: int) -> Iterator[int]:
    """Calls ``task(first)``, ``task(first + 1)``, ... in worker processes and yields each number once it is done, in order.

    A worker that dies is reported as a warning; what it and the others had under way is done again.

    Args:
        task: picklable; calling it again for the same number must do no harm.
        first: the first number.
        workers: processes.

    Raises:
        RuntimeError: if workers die three times in a row without anything done between.
        Exception: whatever ``task`` raises.

    >>> numbers = in_order(abs, 3, workers=1)
    >>> next(numbers), next(numbers)
    (3, 4)
    >>> numbers.close()
    """
    failures = 0
    while True:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            ahead: deque[Future] = deque()
            try:
                numbers = count(first)
                while True:
                    while len(ahead) < _AHEAD * workers:
                        ahead.append(pool.submit(task, next(numbers)))
                    ahead.popleft().result()
                    failures, first = 0, first + 1
                    yield first - 1
            except BrokenProcessPool as error:
                failures += 1
                if failures == _FAILURES:
                    raise RuntimeError(f"workers died {failures} times in a row at number {first}") from error
                warnings.warn(f"a worker died: going on from number {first}", RuntimeWarning, stacklevel=2)
            finally:
                for future in ahead:
                    future.cancel()
