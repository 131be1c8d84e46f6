"""One process at a time works on an output, and the next is told who does."""

import os
import signal
import subprocess
import sys

import pytest

from torchrl_sparse.runtime.lock import lock_output

HOLD = """
import subprocess, sys, time
from torchrl_sparse.runtime.lock import lock_output
with lock_output(sys.argv[1]) as lock:
    if len(sys.argv) > 2:
        subprocess.Popen(["sleep", sys.argv[2]], pass_fds=[lock], stdout=subprocess.DEVNULL)
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def hold():
    """Starts processes that hold a folder, and ends them."""
    started = []

    def start(*arguments):
        command = [sys.executable, "-c", HOLD, *map(str, arguments)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert started[-1].stdout.readline() == "held\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


def refused(out, message):
    with pytest.raises(BlockingIOError, match=message), lock_output(out):
        pass


def kill(process):
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_the_second_is_told_who_holds_it_and_leaves_nothing_behind(tmp_path, hold):
    process = hold(tmp_path / "run")
    before = sorted(tmp_path.rglob("*"))
    told = rf"^out: .*run is locked by process {process.pid} on .* since 20\d\d-.*: -c "
    refused(tmp_path / "run", told)
    assert sorted(tmp_path.rglob("*")) == before


def test_the_same_process_has_to_wait_its_turn_too(tmp_path):
    with lock_output(tmp_path):
        refused(tmp_path, f"locked by process {os.getpid()} ")
        with lock_output(tmp_path / "other"):
            pass
    with lock_output(tmp_path):
        pass


def test_a_dead_process_holds_nobody_up(tmp_path, hold):
    kill(hold(tmp_path / "run"))
    assert (tmp_path / "run" / ".lock").exists()
    with lock_output(tmp_path / "run"):
        pass
    assert not (tmp_path / "run" / ".lock").exists()


def test_what_a_dead_process_left_running_is_waited_for(tmp_path, hold, capsys):
    process = hold(tmp_path, 1)
    kill(process)
    with lock_output(tmp_path):
        pass
    assert capsys.readouterr().out.startswith(f"waiting for what process {process.pid} ")


@pytest.mark.parametrize("is_file", [False, True])
def test_only_what_the_block_wrote_stays(tmp_path, is_file):
    out = tmp_path / "new" / "folder" / "out"
    with lock_output(out, is_file=is_file):
        pass
    assert list(tmp_path.iterdir()) == []
    with lock_output(out, is_file=is_file):
        (out if is_file else out / "file").write_text("made")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["out" if is_file else "file"]


def test_a_lock_that_says_nothing_is_held_all_the_same(tmp_path):
    with lock_output(tmp_path):
        (tmp_path / ".lock").write_text("{")
        refused(tmp_path, "locked by another process")
