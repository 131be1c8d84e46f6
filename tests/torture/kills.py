"""Recipes killed at random moments, their start included, and run again until they finish: nothing is lost, none hangs."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

from tests.torture.contents import contents, difference
from tests.torture.processes import Hang, Run
from tests.torture.recipes import TinyRecipe
from tests.torture.report import Verdict

KILL, WORKER, RESUMED = (
    "the recipe is killed",
    "one of its workers is killed",
    "run again, it ends as if never killed",
)
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_SLOWER = 4  # times the length of an undisturbed run after which a run has hung
_LEAST = 300.0  # seconds that are always granted: others use the machine too
_CHAIN = 7  # kills of one folder


@dataclass(frozen=True)
class Unbroken:
    """A run that nobody disturbed: what it left, and its seconds."""

    contents: list[tuple[str, Any]]
    seconds: float

    @property
    def limit(self) -> float:
        """Seconds after which another such run has hung."""
        return max(_LEAST, _SLOWER * self.seconds)


class Killer:
    """Kills one recipe again and again.

    Args:
        tiny: the recipe.
        work: a folder for its runs.
        rng: chooses signals and moments.
    """

    def __init__(self, tiny: TinyRecipe, work: Path, rng: random.Random) -> None:
        self.tiny, self.rng = tiny, rng
        self._folder, self._log = work / "killed", work / "log.txt"
        self.unbroken = self._run_unbroken(work / "unbroken")

    def _run_unbroken(self, folder: Path) -> Unbroken:
        folder.mkdir(parents=True)
        began = time.monotonic()
        run = self._start(folder)
        if run.wait(1800):
            raise RuntimeError(f"{self.tiny.name}: expected exit code 0 undisturbed, got {run.last_line}")
        return Unbroken(contents(folder), time.monotonic() - began)

    def _start(self, folder: Path) -> Run:
        return Run(self.tiny.command(folder), self._log, self.tiny.environment)

    def chain(self, kills: int = _CHAIN, deadline: float = float("inf")) -> Iterator[Verdict]:
        """Kill runs on one folder, ``kills`` times or until the deadline, then let one finish and compare what it left."""
        self._folder.mkdir()
        done = 0
        try:
            while done < kills and time.monotonic() < deadline:
                verdict, finished = self._kill_once()
                if verdict is not None:
                    done += 1
                    yield verdict
                if finished:
                    break
            yield Verdict(RESUMED, self.tiny.name, f"after {done} kills", self._fault_of_the_end())
        finally:
            shutil.rmtree(self._folder)

    def _kill_once(self) -> tuple[Verdict | None, bool]:
        """Run until a random moment and kill; return the verdict, None if the run was faster, and whether it has finished."""
        moment = self.rng.uniform(0.0, self.unbroken.seconds)
        run = self._start(self._folder)
        while time.time() - run.began < moment and run.process.poll() is None:
            time.sleep(0.02)
        if run.process.poll() is not None:
            run.wait(self.unbroken.limit)
            return None, True  # what came of it is seen when the run after it ends
        if self.tiny.workers and self.rng.random() < 0.5 and (workers := run.workers()):
            return self._kill_worker(run, self.rng.choice(workers), moment)
        return self._kill(run, self.rng.choice(SIGNALS), moment)

    def _kill(self, run: Run, number: signal.Signals, moment: float) -> tuple[Verdict, bool]:
        tags, case = self._tags(run, number.name), f"{number.name} after {moment:.1f} s"
        run.send(number)
        try:
            code, fault = run.wait(self.unbroken.limit), None
        except Hang as hang:
            code, fault = None, str(hang)
        return Verdict(
            KILL, self.tiny.name, case, fault, tags
        ), code == 0 and "stopped by" not in run.last_line

    def _kill_worker(self, run: Run, worker: int, moment: float) -> tuple[Verdict, bool]:
        """Kill one worker; the recipe is to go on by itself."""
        tags, case = self._tags(run, "SIGKILL"), f"SIGKILL after {moment:.1f} s"
        with suppress(ProcessLookupError):  # it had just ended
            os.kill(worker, signal.SIGKILL)
        try:
            code = run.wait(self.unbroken.limit)
            fault = f"expected the recipe to go on, got exit code {code}: {run.last_line}" if code else None
        except Hang as hang:
            code, fault = None, str(hang)
        return Verdict(WORKER, self.tiny.name, case, fault, tags), code == 0

    def _tags(self, run: Run, name: str) -> tuple[str, ...]:
        files = [path for path in self._folder.rglob("*") if path.is_file() and path.name != ".lock"]
        starting = all(path.stat().st_mtime < run.began for path in files)
        return (name, "before anything was written") if starting else (name,)

    def _fault_of_the_end(self) -> str | None:
        run = self._start(self._folder)
        try:
            code = run.wait(self.unbroken.limit)
        except Hang as hang:
            return str(hang)
        if code:
            return f"expected exit code 0, got {code}: {run.last_line}"
        return difference(contents(self._folder), self.unbroken.contents)


def torture_recipes(killers: list[Killer], deadline: float, kills: int | None = None) -> Iterator[Verdict]:
    """Kill recipes in turn, chain by chain, until ``deadline`` on the monotonic clock or until ``kills`` were made."""
    made = 0
    for killer in cycle(killers):
        for verdict in killer.chain(deadline=deadline):
            made += verdict.part != RESUMED
            yield verdict
        if time.monotonic() > deadline or (kills is not None and made >= kills):
            return
