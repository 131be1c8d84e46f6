"""The command: it says where it serves, and ends cleanly at a signal."""

import os
import re
import signal
import time

import numpy as np
import pytest

from tests.recipe_modules import run, started
from tests.serving.robots import Client
from torchrl_sparse import ChunkExecutor

pytestmark = pytest.mark.full


def wait(path, pattern, seconds=120):
    for _ in range(seconds * 20):
        if found := re.search(pattern, path.read_text() if path.exists() else ""):
            return found
        time.sleep(0.05)
    pytest.fail(f"no {pattern!r} in {path.read_text()!r}")


@pytest.fixture
def saved(policy, tmp_path):
    policy.save_pretrained(tmp_path / "policy", half=False)
    return tmp_path / "policy"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_a_signal(saved, policy, tmp_path, episode, number):
    printed = [tmp_path / "stdout", tmp_path / "stderr"]
    process = started("serve", f"policy={saved}", "port=0", "n_action_steps=2", printed=printed)
    port = int(wait(printed[0], r"ws://127\.0\.0\.1:(\d+)")[1])
    actor, states = ChunkExecutor(policy, 2), episode(0)
    actor.reset(seed=0)
    with Client(port) as robot:
        assert robot.metadata["policy"] == str(saved)
        answers = [robot.act(state)[0] for state in states]
        np.testing.assert_array_equal(answers, [actor.act({"state": state}) for state in states])
        os.kill(process.pid, number)
        process.join(60)
    assert process.exitcode == 0
    assert printed[0].read_text().endswith("served 8 requests\n")
    assert printed[1].read_text() == ""


def test_an_address_in_use_and_wrong_options_are_a_line(saved):
    taken = run("serve", f"policy={saved}", "host=256.0.0.1", expect=2)
    assert len(taken.strip().splitlines()) == 1
    refused = run("serve", f"policy={saved}", "answers=chunk", "n_action_steps=4", expect=2)
    assert refused.startswith("n_action_steps: expected null with answers=chunk")
    refused = run("serve", f"policy={saved}", "method=bac", expect=2)
    assert refused.startswith("method: expected a schedule of num_updates updates in planners")
