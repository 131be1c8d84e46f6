"""Episodes do not depend on how many workers ran them, nor where, nor on a worker that died on the way."""

import os
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torchrl.data import NonTensor

from tests.evaluation.rollouts.fakes import FakeActor, FakeEnv
from torchrl_sparse import keys
from torchrl_sparse.evaluation.rollouts import paired
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes

SEEDS = range(7)


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


def test_words_reach_the_actor_in_every_worker(backend):
    episodes = rollout_episodes(ListeningActor(), SpeakingEnv, SEEDS, workers=2, num_envs=2, backend=backend)
    assert [episode.flops_total for episode in episodes] == [
        episode.queries * episode.seed for episode in episodes
    ]
    assert episodes == rollout_episodes(ListeningActor(), SpeakingEnv, SEEDS)


def test_a_worker_that_is_killed_is_reported_and_loses_no_episode(tmp_path, backend):
    log, make_env = tmp_path / "episodes.jsonl", partial(MortalEnv, folder=tmp_path)
    said = {"process": r"exit code -9.*episodes are run anew", "ray": r"a Ray worker died: .*are run anew"}
    with pytest.warns(RuntimeWarning, match=said[backend]):
        episodes = run(make_env, workers=2, num_envs=1, results_file=log, backend=backend)
    assert episodes == run(FakeEnv)
    assert (tmp_path / "died").exists()
    assert len(log.read_text().splitlines()) == 1 + len(SEEDS)


class Doomed:
    """A collector whose first worker has been killed."""

    def __init__(self, started):
        started.append(self)
        self.procs = [
            SimpleNamespace(_closed=False, exitcode=-9),
            SimpleNamespace(_closed=True, exitcode=None),
        ]
        self.shut = False

    def __iter__(self):
        raise ValueError("Cannot close a process while it is still running.")

    def shutdown(self):
        self.shut = True


def test_workers_that_keep_dying_end_the_run():
    started = []
    with (
        pytest.warns(RuntimeWarning),
        pytest.raises(RuntimeError, match="worker 0 ended with exit code -9, 3 times"),
    ):
        list(paired._episodes(lambda seeds: Doomed(started), [3, 8]))
    assert [collector.shut for collector in started] == [True] * 3


def test_an_error_without_a_death_is_not_tried_again():
    started = []

    def start(seeds):
        collector = Doomed(started)
        collector.procs[0].exitcode = None
        return collector

    with pytest.raises(ValueError, match="Cannot close"):
        list(paired._episodes(start, [3, 8]))
    assert len(started) == 1


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


class BrokenEnv(FakeEnv):
    """Cannot be stepped."""

    def _step(self, tensordict):
        raise ArithmeticError("no step")


@pytest.mark.xfail(
    reason="Ray 2.60 fails while it stores the error, and the worker dies instead", strict=True
)
def test_what_a_ray_worker_raises_is_raised_and_not_tried_again(ray_cluster):
    with pytest.raises(ArithmeticError, match="no step"):
        run(BrokenEnv, backend="ray")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers: expected at least 1, got 0"),
        ({"backend": "smoke"}, "backend: expected one of process, ray, got 'smoke'"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(ValueError, match=message):
        run(FakeEnv, **options)


def test_ray_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl-sparse\[ray\]'"):
        run(FakeEnv, backend="ray")
