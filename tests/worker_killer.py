"""Ends the workers of this process at moments of its choice."""

import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

SIGNALS = {
    "process": (signal.SIGKILL, signal.SIGTERM, signal.SIGINT),
    "ray": (signal.SIGKILL, signal.SIGTERM),  # which takes an interrupt for a task that is cancelled
}
PATIENCE = 20  # s


class Killer(threading.Thread):
    """Waits for a worker that it has not seen, then for the next of ``delays`` (seconds), and ends it by one signal or another.

    Makes the file ``done`` after the last.
    """

    def __init__(self, backend, delays, done):
        super().__init__(daemon=True)
        self.signals, self.delays, self.done = SIGNALS[backend], delays, done

    def run(self):
        doomed = set()  # the others go with the one that is killed
        for number, delay in enumerate(self.delays):
            _wait_for_workers(doomed)
            time.sleep(delay)
            alive = _wait_for_workers(doomed)
            _end(min(alive), self.signals[number % len(self.signals)])
            doomed |= alive
        self.done.touch()


def _end(pid, number):
    """Python drops an interrupt that falls into a finaliser or a callback of the garbage collector."""
    with suppress(ProcessLookupError):
        os.kill(pid, number)
        deadline = time.monotonic() + PATIENCE
        while _is_worker(pid) and time.monotonic() < deadline:
            time.sleep(0.005)
        os.kill(pid, signal.SIGKILL)


def _wait_for_workers(doomed):
    while not (alive := workers() - doomed):
        time.sleep(0.005)
    return alive


def workers():
    """The processes of collectors and pools below this one, from their fork on."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
    return {pid for pid in parents if _is_worker(pid) and _is_below(pid, parents)}


def _is_worker(pid):
    with suppress(OSError):
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
        return b"spawn_main" in command or command.startswith((b"ray::_RayWorker", b"ray::_call"))
    return False


def _is_below(pid, parents):
    while pid in parents:
        pid = parents[pid]
        if pid == os.getpid():
            return True
    return False
