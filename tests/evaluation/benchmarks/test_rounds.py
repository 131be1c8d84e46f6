"""Benchmarks stop where their episodes decide, whatever was run before, and dense runs as far as any method."""

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.benchmarks.rounds import make_design, play_rounds
from torchrl_sparse.evaluation.results.build import Terms
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.sequential import Design

RATES = {"dense": 0.9, "good": 0.93, "close": 0.84, "bad": 0.5}


def episodes_of(name):
    """As many as anybody asks for, the same whenever they are asked for."""
    solved = np.random.default_rng(len(name)).random(1000) < RATES[name]
    return [EpisodeResult(seed, bool(s), 100 if s else 400, 4, 1e9, 0.0) for seed, s in enumerate(solved)]


class Player:
    """Remembers what it has played, as a log does."""

    def __init__(self):
        self.asked, self.run = [], dict.fromkeys(RATES, 0)

    def __call__(self, name, n):
        self.asked.append((name, n))
        self.run[name] = max(self.run[name], n)
        return episodes_of(name)[:n]


def terms(analyses):
    return Terms(Design(1000, analyses), episode_horizon=400)


def test_a_fixed_number_is_played_by_all():
    player = Player()
    episodes = play_rounds(RATES, player, terms(1))
    assert list(episodes) == list(RATES)
    assert {len(played) for played in episodes.values()} == {1000}
    assert len(player.asked) == 4


def test_methods_stop_where_they_are_decided_and_dense_runs_as_far_as_any():
    player = Player()
    episodes = play_rounds(RATES, player, terms(20))
    played = {name: len(of_method) for name, of_method in episodes.items()}
    assert played["bad"] < played["good"] < 1000
    assert played["close"] == played["dense"] == 1000
    assert player.run == played


def test_a_benchmark_that_was_killed_stops_where_it_would_have_stopped():
    killed = Player()

    def play(name, n):
        if sum(killed.run.values()) > 600:
            raise KeyboardInterrupt
        return killed(name, n)

    with pytest.raises(KeyboardInterrupt):
        play_rounds(RATES, play, terms(20))
    assert play_rounds(RATES, killed, terms(20)) == play_rounds(RATES, Player(), terms(20))


def test_dense_alone_is_played_to_the_end():
    assert len(play_rounds(["dense"], Player(), terms(20))["dense"]) == 1000


def test_a_design_is_a_number_or_a_cap():
    assert make_design("conclusive", 5, 90).ends[-1] == 90
    assert make_design("conclusive", 5, 90) == Design(90, 9)
    assert make_design("episodes", 5, 90) == Design(5)
    assert make_design("conclusive", 5, 100).ends == tuple(range(10, 101, 10))  # not after every few episodes
    assert make_design("conclusive", 5, 7).ends == (7,)
    with refused("until"):
        make_design("bored", 5, 90)
    with refused("analyses"):
        make_design("episodes", 0, 90)
