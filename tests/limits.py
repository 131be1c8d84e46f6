"""What reading a file costs, in another process: seconds of the CPU, and memory beyond that of the imported library.

A small file must not exhaust a machine: whatever it says, it is read or refused within `SECONDS` and `MEGABYTES`.
"""

import ctypes
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.forked import FORKED

SECONDS, MEGABYTES = 10, 1000  # a CPU whose host is busy takes twice as long as a free one
SMALL_FILE = 10_000_000


@dataclass(frozen=True)
class Cost:
    """What a call took, and the text of the error that it ended with."""

    error: str | None
    seconds: float
    megabytes: float


class _Reader:
    """A process that reads one file after the other, and another in its place once it was ended."""

    def __init__(self) -> None:
        self._process, self._pipe = None, None

    def measure(self, read: Callable, path: Path) -> Cost:
        if self._process is None:
            self._start()
        self._pipe.send((read, path))
        try:
            assert self._pipe.poll(40 * SECONDS), "it waits for something"  # other processes may have the CPU
            return self._pipe.recv()
        except EOFError:
            self._process.join()
            pytest.fail(
                f"it was ended, exit code {self._process.exitcode} (-24: it took more than {SECONDS} s)"
            )
        finally:
            if sys.exc_info()[0] is not None:
                self._process.kill()
                self._process = None

    def _start(self) -> None:
        self._pipe, theirs = FORKED.Pipe()
        self._process = FORKED.Process(target=_answer, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()


_READER = _Reader()


def measure(read: Callable, path: Path) -> Cost:
    """Call ``read(path)`` in a process that is killed when it exceeds the limits."""
    if sys.platform != "linux":
        pytest.skip("limits are Linux's")
    return _READER.measure(read, path)


def check_limits(read: Callable, path: Path) -> str | None:
    """Return the error, of one line, with which ``read(path)`` refuses a small file, or None if it reads it."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) < SMALL_FILE
    cost = measure(read, path)
    assert cost.seconds < SECONDS
    assert cost.megabytes < MEGABYTES
    if cost.error is not None:
        assert "alloc" not in cost.error, "it was the limit that ended it"
        assert len(cost.error.splitlines()) == 1
        assert len(cost.error) < 1000
    return cost.error


def _answer(pipe) -> None:
    import torch

    torch.set_num_threads(1)
    while True:
        read, path = pipe.recv()
        pipe.send(_call(read, path))


def _call(read: Callable, path: Path) -> Cost:
    ctypes.CDLL(None).malloc_trim(0)  # what an earlier file left is not to serve this one
    Path("/proc/self/clear_refs").write_text("5")  # forget the highest resident size so far
    before, began = _memory(), time.process_time()
    _limit(resource.RLIMIT_AS, before["VmSize"] + MEGABYTES * 1_000_000)
    _limit(resource.RLIMIT_CPU, int(began) + SECONDS + 2)
    error = None
    try:
        read(path)
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}"
    spent = time.process_time() - began
    return Cost(error, spent, (_memory()["VmHWM"] - before["VmRSS"]) / 1e6)


def _limit(what: int, most: int) -> None:
    resource.setrlimit(what, (most, resource.getrlimit(what)[1]))


def _memory() -> dict[str, int]:
    """Bytes of this process, by Linux's names."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return {
        key: 1024 * int(value.split()[0])
        for key, value in (line.split(":") for line in lines if "kB" in line)
    }
