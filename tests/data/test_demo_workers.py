"""Work of several workers comes out in order, and a death on the way loses nothing."""

import os
import random
import signal
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from tests.torture.processes import Run
from tests.worker_killer import Killer
from torchrl_sparse.data import demo_workers
from torchrl_sparse.data.demo_workers import in_order


def note(folder, deadly, number):
    """Writes a file; at the number ``deadly`` dies instead, the first time or, below zero, at every number."""
    died = Path(folder) / "died"
    if deadly < 0 or (number == deadly and not died.exists()):
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    (Path(folder) / str(number)).touch()


def hold(folder, number):
    """Waits for a file, then writes one."""
    while not (Path(folder) / "go").exists():
        time.sleep(0.01)
    (Path(folder) / str(number)).touch()


def take(numbers, n):
    taken = [next(numbers) for _ in range(n)]
    numbers.close()
    return taken


def test_comes_in_order(tmp_path, backend):
    assert take(in_order(partial(note, tmp_path, 10**9), 5, workers=2, backend=backend), 4) == [5, 6, 7, 8]
    assert all((tmp_path / str(number)).exists() for number in range(5, 9))


def test_a_dead_worker_is_reported_and_its_work_redone(tmp_path, backend):
    with pytest.warns(RuntimeWarning, match=r"worker died.*; going on from number \d"):
        assert take(in_order(partial(note, tmp_path, 2), 0, workers=2, backend=backend), 4) == [0, 1, 2, 3]
    assert all((tmp_path / str(number)).exists() for number in range(4))


def kill_while_starting(folder, backend, monkeypatch, delays):
    monkeypatch.setattr(demo_workers, "_FAILURES", len(delays) + 1)
    Killer(backend, delays, folder / "go").start()
    number = {"process": "0", "ray": r"\d"}[backend]  # Ray has idle workers too, whose death loses nothing
    with pytest.warns(RuntimeWarning, match=rf"worker died.*; going on from number {number}"):
        assert take(in_order(partial(hold, folder), 0, workers=2, backend=backend), 4) == [0, 1, 2, 3]
    assert all((folder / str(number)).exists() for number in range(4))


def test_workers_that_are_killed_while_they_start_are_replaced(tmp_path, backend, monkeypatch):
    kill_while_starting(tmp_path, backend, monkeypatch, [0.0, 0.2, 1.0])


def test_a_worker_that_dies_while_the_next_is_started_is_replaced(tmp_path, monkeypatch):
    """Before Python 3.12 the pool then closes the pipe that the next is about to be given."""
    spawn, killed = ProcessPoolExecutor._spawn_process, []

    def kill_the_first(pool):
        if pool._processes and not killed:
            killed.extend(pool._processes)
            os.kill(killed[0], signal.SIGKILL)
            deadline = time.monotonic() + 5
            while not pool._call_queue._reader.closed and time.monotonic() < deadline:
                time.sleep(0.01)
        spawn(pool)

    monkeypatch.setattr(ProcessPoolExecutor, "_spawn_process", kill_the_first)
    with pytest.warns(RuntimeWarning, match=r"worker died.*; going on from number 0"):
        assert take(in_order(partial(note, tmp_path, 10**9), 0, workers=2), 4) == [0, 1, 2, 3]
    assert killed


@pytest.mark.slow
def test_workers_that_are_killed_at_ten_moments_are_replaced(tmp_path, backend, monkeypatch):
    drawn = random.Random(0)
    kill_while_starting(tmp_path, backend, monkeypatch, [3 * drawn.random() for _ in range(10)])


def test_workers_that_keep_dying_end_it(tmp_path, backend):
    with pytest.warns(RuntimeWarning), pytest.raises(RuntimeError, match="died 3 times in a row at number 0"):
        take(in_order(partial(note, tmp_path, -1), 0, workers=1, backend=backend), 1)


def test_what_the_work_raises_is_raised(backend):
    with pytest.raises(TypeError, match="str"):
        take(in_order(os.getenv, 0, workers=1, backend=backend), 1)


@pytest.mark.skipif(sys.platform != "linux", reason="sessions are read in /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    program = "import time; from torchrl_sparse.data.demo_workers import in_order\n"
    program += "for number in in_order(time.sleep, 0, workers=2): print('slept', number, flush=True)"
    run = Run([sys.executable, "-c", program], tmp_path / "log.txt", {})
    while "slept 1" not in run.output:
        assert run.process.poll() is None, run.output
        time.sleep(0.1)
    assert run.workers()
    run.process.kill()
    run.wait(60)  # raises if a worker stays
