"""Episodes do not depend on how many workers ran them, nor where, nor on a worker that died on the way."""

import multiprocessing
import os
import random
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torchrl.data import NonTensor

from tests.evaluation.rollouts.fakes import FakeActor, FakeEnv
from tests.refusals import refused
from tests.worker_killer import Killer
from torchrl_sparse import keys
from torchrl_sparse.evaluation.rollouts import paired, process_collector
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
from torchrl_sparse.runtime.backends import WorkerDied

SEEDS = range(7)


@pytest.fixture(autouse=True)
def nobody_is_left():
    before = set(multiprocessing.active_children())  # those of other tests
    yield
    assert set(multiprocessing.active_children()) <= before


class MortalEnv(FakeEnv):
    """Kills its process, once per folder, at the third step of the seed 3."""

    def __init__(self, seeds, folder):
        super().__init__(seeds)
        self.died = Path(folder) / "died"

    def _step(self, tensordict):
        if self.seed == 3 and self.elapsed == 2 and not self.died.exists():
            self.died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._step(tensordict)


def run(make_env, **kwargs):
    return rollout_episodes(FakeActor(), make_env, SEEDS, **kwargs)


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")
@pytest.mark.parametrize(("workers", "num_envs"), [(1, 3), (2, 2)])
def test_workers_find_what_this_process_finds(backend, workers, num_envs):
    assert run(FakeEnv, workers=workers, num_envs=num_envs, backend=backend) == run(FakeEnv)


class SpeakingEnv(FakeEnv):
    """Says which seed it is at."""

    def __init__(self, seeds):
        super().__init__(seeds)
        self.observation_spec[keys.INSTRUCTION] = NonTensor((), example_data="go to 0")

    def _observe(self):
        return super()._observe().set(keys.INSTRUCTION, f"go to {self.seed}")


class ListeningActor(FakeActor):
    """Pays as many FLOPs as the words say."""

    def __init__(self):
        super().__init__()
        self.in_keys.append(keys.INSTRUCTION)

    def forward(self, tensordict):
        told = [float(words.split()[-1]) for words in tensordict[keys.INSTRUCTION]]
        return super().forward(tensordict).set(keys.FLOPS, torch.tensor(told)[:, None])


@pytest.mark.usefixtures("forked_workers")
def test_words_reach_the_actor_in_every_worker(backend):
    episodes = rollout_episodes(ListeningActor(), SpeakingEnv, SEEDS, workers=2, num_envs=2, backend=backend)
    assert [episode.flops_total for episode in episodes] == [
        episode.queries * episode.seed for episode in episodes
    ]
    assert episodes == rollout_episodes(ListeningActor(), SpeakingEnv, SEEDS)


@pytest.mark.usefixtures("forked_workers")
def test_a_worker_that_is_killed_is_reported_and_loses_no_episode(tmp_path, backend):
    log, make_env = tmp_path / "episodes.jsonl", partial(MortalEnv, folder=tmp_path)
    said = {"process": r"exit code -9.*episodes are run again", "ray": r"a Ray worker died: .*are run again"}
    with pytest.warns(RuntimeWarning, match=said[backend]):
        episodes = run(make_env, workers=2, num_envs=1, results_file=log, backend=backend)
    assert episodes == run(FakeEnv)
    assert (tmp_path / "died").exists()
    assert len(log.read_text().splitlines()) == 1 + len(SEEDS)


class HeldEnv(FakeEnv):
    """Takes no step before a file is there."""

    def __init__(self, seeds, go):
        super().__init__(seeds)
        self.go = go

    def _step(self, tensordict):
        while not self.go.exists():
            time.sleep(0.01)
        return super()._step(tensordict)


def kill_while_starting(monkeypatch, backend, go, delays):
    """Runs all episodes while workers are killed before their first batch, each so many seconds after its fork."""
    monkeypatch.setattr(paired, "_FAILURES", len(delays) + 1)
    killer = Killer(backend, delays, go)
    killer.start()
    with pytest.warns(RuntimeWarning, match="episodes are run again") as warned:
        episodes = run(partial(HeldEnv, go=go), workers=2, num_envs=2, backend=backend)
    deaths = [warning for warning in warned if warning.category is RuntimeWarning]
    assert 1 <= len(deaths) <= len(delays)
    assert episodes == run(FakeEnv)


def test_workers_that_are_killed_while_they_start_are_replaced(tmp_path, monkeypatch, backend):
    kill_while_starting(monkeypatch, backend, tmp_path / "go", [0.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_workers_that_are_killed_at_ten_moments_are_replaced(tmp_path, monkeypatch, backend, seed):
    drawn = random.Random(seed)
    kill_while_starting(monkeypatch, backend, tmp_path / "go", [8 * drawn.random() for _ in range(10)])


def test_workers_that_do_not_start_in_time_are_given_up(monkeypatch):
    monkeypatch.setattr(process_collector, "START_LIMIT", 0.5)
    monkeypatch.setattr(paired, "_FAILURES", 1)
    with pytest.raises(RuntimeError, match=r"workers had not started after 0\.5 s, 1 times"):
        run(FakeEnv, workers=2)


class UnmakeableEnv(FakeEnv):
    """Cannot be made."""

    def __init__(self, seeds):
        raise ArithmeticError("no environment")


class BrokenEnv(FakeEnv):
    """Cannot be stepped."""

    def _step(self, tensordict):
        raise ArithmeticError("no step")


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_a_worker_raises_while_it_starts_is_raised_and_not_tried_again(backend):
    kind = ArithmeticError if backend == "process" else sys.modules["ray"].exceptions.RayActorError
    with pytest.raises(kind, match="no environment"):
        run(UnmakeableEnv, workers=2, backend=backend)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_a_ray_worker_raises_is_raised_and_not_tried_again(ray_cluster):
    with pytest.raises(ArithmeticError, match="no step"):
        run(BrokenEnv, backend="ray")


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_a_worker_process_raises_ends_the_run(capfd):
    with pytest.raises(RuntimeError, match=r"worker \d ended with exit code 1.*its traceback is above"):
        run(BrokenEnv, workers=2)
    assert "ArithmeticError: no step" in capfd.readouterr().err


def test_workers_that_keep_dying_end_the_run():
    started = []

    @contextmanager
    def doomed(seeds):
        started.append(seeds)
        raise WorkerDied("worker 0 ended with exit code -9")
        yield

    with (
        pytest.warns(RuntimeWarning),
        pytest.raises(RuntimeError, match="worker 0 ended with exit code -9, 3 times"),
    ):
        list(paired._episodes(doomed, [3, 8]))
    assert started == [[3, 8]] * 3


@pytest.mark.usefixtures("forked_workers")
def test_robosuite_gives_the_same_in_two_workers(backend):
    from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, make_env

    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddim", 3)
    make = partial(make_env, "Lift", horizon=10)
    runs = [
        rollout_episodes(ChunkExecutor(policy), make, [100_000, 100_001], num_envs=1, **where)
        # the second with an engine that has already run here
        for where in ({}, {"workers": 2, "backend": backend})
    ]
    one, two = ([replace(episode, latency=()) for episode in episodes] for episodes in runs)
    assert one == two
    assert all(episode.queries == 2 for episode in one)


@pytest.mark.parametrize(
    ("options", "entry"),
    [
        ({"workers": 0}, "workers"),
        ({"backend": "smoke"}, "backend"),
    ],
)
def test_options_are_checked(options, entry):
    with refused(entry):
        run(FakeEnv, **options)


def test_ray_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl-sparse\[ray\]'"):
        run(FakeEnv, backend="ray")
