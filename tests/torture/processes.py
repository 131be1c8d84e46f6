"""A recipe as a process in a session of its own: started, signalled, waited for, with all processes that it began. Linux."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[2]
_TICK = 0.05
_OWN_ENDING = 60.0  # seconds that what is left over may take to end by itself


class Hang(Exception):
    """A process did not end in time; all of its session is killed."""


class Run:
    """A running command, in a session of its own.

    Args:
        command: its words.
        log: what it prints goes there.
        environment: entries on top of this process' own.
        prepare: called in the child before the command.
    """

    def __init__(
        self,
        command: Sequence[str],
        log: Path,
        environment: dict[str, str],
        prepare: Callable[[], None] = lambda: None,
    ) -> None:
        self._log, self.began = log, time.time()
        with open(log, "wb") as file:
            self.process = subprocess.Popen(
                command,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | environment,
                start_new_session=True,
                preexec_fn=partial(_begin, prepare),
            )

    @property
    def output(self) -> str:
        """What it printed so far."""
        return self._log.read_text(errors="replace")

    @property
    def last_line(self) -> str:
        """The last line that it printed."""
        return (self.output.strip().splitlines() or ["nothing printed"])[-1][-300:]

    def wait(self, seconds: float) -> int:
        """Wait for its end and that of all that it began; return its exit code.

        Raises:
            Hang: if it, or something of it, is still there.
        """
        try:
            code = self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.destroy()
            raise Hang(f"did not end within {seconds:.0f} s; last line: {self.last_line}") from None
        deadline = time.monotonic() + _OWN_ENDING
        while left := self.members():
            if time.monotonic() > deadline:
                names = ", ".join(sorted({_command(pid)[:60] for pid in left}))
                self.destroy()
                raise Hang(f"left processes that go on without it: {names}")
            time.sleep(_TICK)
        return code

    def members(self) -> list[int]:
        """Return the processes of its session, itself included."""
        return [pid for pid in _pids() if _session(pid) == self.process.pid]

    def workers(self) -> list[int]:
        """Return the processes that run its work beside it."""
        others = [pid for pid in self.members() if pid != self.process.pid]
        return [
            pid for pid in others if "python" in _command(pid) and "resource_tracker" not in _command(pid)
        ]

    def send(self, number: signal.Signals) -> None:
        """Send a signal as users do: an interrupt goes to all, as a terminal sends it, others to the process itself."""
        if number == signal.SIGINT:
            os.killpg(self.process.pid, number)
        else:
            self.process.send_signal(number)

    def destroy(self) -> None:
        """Kill all of its session."""
        for pid in self.members():
            os.kill(pid, signal.SIGKILL)
        self.process.wait()


def recipe(name: str, *options: str) -> list[str]:
    """Return the command that runs a recipe."""
    return [sys.executable, str(ROOT / "recipes" / f"{name}.py"), *options]


def _begin(prepare: Callable[[], None]) -> None:
    signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # a shell's background job ignores it, and so would its children
    prepare()


def _pids() -> list[int]:
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]


def _session(pid: int) -> int | None:
    """Return a living process' session; None for one that has ended."""
    try:
        state, _, _, session = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:4]
    except (OSError, ValueError):
        return None
    return None if state == "Z" else int(session)


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""
