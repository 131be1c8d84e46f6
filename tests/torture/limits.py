"""A call in a forked process that may take so much time and memory, and no more."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import select
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

SECONDS, GIGABYTES = 5, 1.0
"""What any file under 10 MB may take to be answered or refused."""

_MESSAGE = 5_000  # characters kept of an error's
_PATIENCE = 20  # wall seconds for one of the processor's, which others use too
_ENDINGS = {signal.SIGXCPU: "took more than its seconds", signal.SIGKILL: "did not end"}


@dataclass(frozen=True)
class Outcome:
    """How a call ended: ``error`` is the name of what it raised, "died", or None where it returned; ``text`` its message."""

    error: str | None
    text: str


def run_limited(
    call: Callable[[], Any], *, seconds: int = SECONDS, gigabytes: float | None = GIGABYTES
) -> Outcome:
    """Call without arguments in a process of its own and tell how it ended.

    Args:
        call: what to do; what it returns is dropped.
        seconds: of the processor's time.
        gigabytes: of address space beyond this process' own; None where a sanitizer needs all of it.

    >>> run_limited(lambda: int("x")).error
    'ValueError'
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _work(call, writer, seconds, gigabytes)
    os.close(writer)
    message = _listen(reader, seconds * _PATIENCE)
    if message is None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        number = signal.Signals(os.WTERMSIG(status))
        return Outcome("died", _ENDINGS.get(number, f"was ended by {number.name}"))
    return Outcome(*json.loads(message)) if message else Outcome("died", "ended without an answer")


def _work(call: Callable[[], Any], writer: int, seconds: int, gigabytes: float | None) -> None:
    """Do the child's part; never return."""
    try:
        faulthandler.disable()  # how it ended is told by its status, not on stderr
        torch.set_num_threads(1)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if gigabytes is not None:
            limit = _address_space() + int(gigabytes * 2**30)
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        call()
        answer = [None, ""]
    except BaseException as error:
        answer = [type(error).__name__, str(error)[:_MESSAGE]]
    with suppress(BaseException):
        os.write(writer, json.dumps(answer).encode())
    os._exit(0)


def _listen(reader: int, seconds: float) -> bytes | None:
    """Return what the child writes until it ends, or None if it does not."""
    deadline, parts = time.monotonic() + seconds, []
    with open(reader, "rb", buffering=0) as pipe:
        while (left := deadline - time.monotonic()) > 0:
            if select.select([pipe], [], [], left)[0]:
                if not (part := pipe.read(65536)):
                    return b"".join(parts)
                parts.append(part)
    return None


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
