"""A multi-process TorchRL collector with a start-up timeout that reports which process died."""

from __future__ import annotations

import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cloudpickle
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, MultiAsyncCollector
from torchrl.envs import EnvBase

from torchrl_sparse.runtime.backends import WorkerDied

__all__ = ["START_LIMIT", "in_processes", "time_limit"]

START_LIMIT = 600.0  # seconds after which workers that have not started are given up
_REAPING = 2.0  # seconds until a process whose pipe is broken has an exit code


@contextmanager
def in_processes(
    make: Sequence[Callable[[], EnvBase]], actor: TensorDictModuleBase, **options: Any
) -> Iterator[BaseCollector]:
    """Collect during the block in one process per environment factory.

    Args:
        make: for each process, makes its environment.
        actor: copied to each of them.
        options: of TorchRL's collector.

    Raises:
        WorkerDied: if one dies, while it starts or in the block, or not all have started after `START_LIMIT` seconds.
        Exception: what one raised while it started.
        RuntimeError: if one raised something later; its traceback is on stderr.
    """
    collector = _start_processes(make, actor, **options)
    try:
        yield collector
    except Exception as error:
        codes = _exit_codes(collector.procs)
        if any(code < 0 for code in codes.values()):
            raise WorkerDied(_in_words(codes)) from error
        if codes:
            raise RuntimeError(f"{_in_words(codes)}; its traceback is above") from error
        raise
    finally:
        collector.shutdown()


def _start_processes(
    make: Sequence[Callable[[], EnvBase]], actor: TensorDictModuleBase, **options: Any
) -> BaseCollector:
    """Start workers that read from files what they run.

    Within the arguments of a process it would go through a pipe, whose reading end this process has open too: if the worker
    died while it read, the writing would never end. Arguments without it fit into the pipe's buffer.
    """
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"environment{index}" for index in range(len(make))]
        for file, content in zip([*files, Path(folder) / "actor"], [*make, actor], strict=True):
            file.write_bytes(cloudpickle.dumps(content))
        return _ProcessCollector(
            [partial(_make_saved, file) for file in files],
            policy_factory=partial(_load, Path(folder) / "actor"),
            total_frames=-1,
            # Without buffers, since words cannot lie in shared memory (tensordict makes arrays of them that no queue takes).
            use_buffers=False,
            num_threads=1,
            # An interrupt then ends a worker as a kill does, instead of as an error of its own.
            init_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
            **options,
        )


def _load(file: Path) -> Any:
    return pickle.loads(file.read_bytes())


def _make_saved(file: Path) -> EnvBase:
    return _load(file)()


class _ProcessCollector(MultiAsyncCollector):
    """Workers that all start, in time, or are all ended. None waits for another: episodes are of unequal length."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._starting, self._lost = True, ""
        try:
            # TorchRL waits for a worker until it reports or its pipe closes.
            with time_limit(START_LIMIT, self._give_up):
                super().__init__(*args, **kwargs)
        except BaseException as error:
            self.shutdown(raise_on_error=False)
            if self._lost and isinstance(error, Exception):
                raise WorkerDied(self._lost) from error
            raise
        self._starting = False

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """End the workers, by a kill those that may not have started: they would not hear a word."""
        if self._starting:
            self._starting = False
            # What a worker raises while it starts it reports to this process, and ends with 0.
            self._lost = self._lost or _in_words(_exit_codes(getattr(self, "procs", ())))
            self._kill()
        super().shutdown(*args, **kwargs)

    def _give_up(self) -> None:
        self._lost = f"workers had not started after {START_LIMIT:g} s"
        self._kill()

    def _kill(self) -> None:
        for process in getattr(self, "procs", ()):
            if not process._closed:
                process.kill()


@contextmanager
def time_limit(seconds: float, give_up: Callable[[], None]) -> Iterator[None]:
    """Call ``give_up`` in a thread, to end the block, if it has not ended after ``seconds``."""
    timer = threading.Timer(seconds, give_up)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _exit_codes(processes: Sequence[BaseProcess]) -> dict[int, int]:
    """Return the exit codes of the workers that ended of themselves other than well."""
    left = {index: process for index, process in enumerate(processes) if not process._closed}
    sentinels = {process.sentinel: process for process in left.values()}
    # A broken pipe is noticed before its process has ended, and the end of that before it can be asked for its code.
    for sentinel in connection.wait(sentinels, timeout=_REAPING) if sentinels else ():
        sentinels[sentinel].join(_REAPING)
    codes = {index: process.exitcode for index, process in left.items() if process.exitcode}
    # TorchRL terminates those that are alive when it finds a dead one.
    return {index: code for index, code in codes.items() if code != -signal.SIGTERM} or codes


def _in_words(codes: Mapping[int, int]) -> str:
    return ", ".join(f"worker {index} ended with exit code {code}" for index, code in codes.items())
