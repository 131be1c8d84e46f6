"""Folders that others use or that are full: two processes on one, and a disk made small."""

from __future__ import annotations

import random
import resource
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from tests.torture.contents import contents, difference
from tests.torture.kills import Killer, Unbroken
from tests.torture.processes import Hang, Run
from tests.torture.recipes import TinyRecipe
from tests.torture.report import Verdict

TWO, FULL = "two processes work in one folder", "the disk is too small, then large enough"
_ROOM = 256 << 20  # bytes, more than any of these runs needs


def torture_folder(killer: Killer, work: Path, rng: random.Random) -> Iterator[Verdict]:
    """Run a recipe twice at a time in one folder, and once on a disk that is too small."""
    tiny, unbroken = killer.tiny, killer.unbroken
    moment = rng.uniform(0.0, unbroken.seconds)
    yield Verdict(
        TWO, tiny.name, f"the second begins after {moment:.1f} s", _two(tiny, unbroken, work, moment)
    )
    share = rng.uniform(0.1, 0.8)
    kind, fault = _small(tiny, unbroken, work, share)
    yield Verdict(FULL, tiny.name, f"{share:.0%} of what it needs", fault, (kind,))


# -- two processes -----------------------------------------------------------------------------------------------------


def _two(tiny: TinyRecipe, unbroken: Unbroken, work: Path, moment: float) -> str | None:
    folder = work / "shared"
    folder.mkdir()
    try:
        runs = [_start(tiny, folder, work / "first.txt")]
        time.sleep(moment)
        runs.append(_start(tiny, folder, work / "second.txt"))
        codes = [run.wait(2 * unbroken.limit) for run in runs]
        return _fault_of_two(codes, runs, folder) or difference(contents(folder), unbroken.contents)
    except Hang as hang:
        for run in runs:
            run.destroy()
        return str(hang)
    finally:
        shutil.rmtree(folder)


def _fault_of_two(codes: list[int], runs: list[Run], folder: Path) -> str | None:
    """One has to finish; the other may, if it waited, or says in a line why not."""
    if 0 not in codes:
        return f"expected one of them to finish, got {[run.last_line for run in runs]}"
    for code, run in zip(codes, runs, strict=True):
        if code and (fault := _unnamed(run, folder)):
            return fault
    return None


def _unnamed(run: Run, folder: Path) -> str | None:
    """Say what an error lacks that should be one line that names a file in the folder."""
    if "Traceback" in run.output:
        return f"expected one line, got a traceback: {run.last_line}"
    return (
        None
        if str(folder) in run.last_line
        else f"expected a line that names the folder, got {run.last_line}"
    )


# -- a small disk ------------------------------------------------------------------------------------------------------


def _small(tiny: TinyRecipe, unbroken: Unbroken, work: Path, share: float) -> tuple[str, str | None]:
    """Return how the disk was made small, and the fault."""
    sizes = [path.stat().st_size for path in (work / "unbroken").rglob("*") if path.is_file()]
    folder = work / "small"
    folder.mkdir()
    try:
        with _tmpfs(folder, int(share * sum(sizes))) as grow:
            return "tmpfs", _fault_of_small(tiny, unbroken, folder, grow)
    except PermissionError:
        limit = int(share * max(sizes))
        prepare = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit))
        return "limit of a file's size", _fault_of_small(tiny, unbroken, folder, lambda: None, prepare)
    finally:
        shutil.rmtree(folder)


@contextmanager
def _tmpfs(folder: Path, size: int) -> Iterator[Callable[[], None]]:
    """Mount a file system of so many bytes on a folder; lend what makes it large.

    Raises:
        PermissionError: where this user may not.
    """
    mount = ["mount", "-t", "tmpfs", "-o", f"size={max(size, 4096)}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        raise PermissionError("expected to be allowed to mount a tmpfs")
    try:
        yield partial(subprocess.run, ["mount", "-o", f"remount,size={_ROOM}", str(folder)], check=True)
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def _fault_of_small(
    tiny: TinyRecipe,
    unbroken: Unbroken,
    folder: Path,
    grow: Callable[[], None],
    prepare: Callable[[], None] = lambda: None,
) -> str | None:
    log = folder.with_name("small.txt")
    try:
        run = _start(tiny, folder, log, prepare)
        if run.wait(unbroken.limit) and (fault := _unnamed(run, folder)):
            return fault
        grow()
        run = _start(tiny, folder, log)
        if code := run.wait(unbroken.limit):
            return f"with room: expected exit code 0, got {code}: {run.last_line}"
    except Hang as hang:
        return str(hang)
    return difference(contents(folder), unbroken.contents)


def _start(tiny: TinyRecipe, folder: Path, log: Path, prepare: Callable[[], None] = lambda: None) -> Run:
    return Run(tiny.command(folder), log, tiny.environment, prepare)
