"""Ends the workers of this process at moments of its choice."""

import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


class Killer(threading.Thread):
    """Waits for a worker that it has not seen, then for the next of ``delays`` (seconds), and ends it by one signal or another.

    Makes the file ``done`` after the last.
    """

    def __init__(self, delays, done):
        super().__init__(daemon=True)
        self.delays, self.done = delays, done

    def run(self):
        seen = set()
        for number, delay in enumerate(self.delays):
            while not (new := workers() - seen):
                time.sleep(0.005)
            time.sleep(delay)
            seen |= new | workers()
            with suppress(ProcessLookupError):
                os.kill(min(new), SIGNALS[number % len(SIGNALS)])
        self.done.touch()


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
