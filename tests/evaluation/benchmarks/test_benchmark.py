"""The order of a benchmark: every kind plays, measures, compares and draws, and dense plays first."""

from types import SimpleNamespace

import pytest

from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.evaluation.benchmarks import benchmark
from torchrl_sparse.evaluation.benchmarks.benchmark import Benchmark, BenchmarkOptions
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.build import MethodRun
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult

TASK = SimpleNamespace(name="Lift", early_cut=None, graded=False)
ASKED = {
    **{"task": "lift", "n_action_steps": 8, "episodes": 3, "horizon": 40, "margin": 0.05, "time_margin": 0.1},
    **{"threads": 1, "latency_repeats": 2, "seed": 5, "dense_log": None, "table": "short"},
}


class Noted(Benchmark):
    """Two methods that need no simulator; notes what it is asked for."""

    names = ("dense", "fast")

    def __init__(self, options, noted):
        self.noted = noted
        super().__init__(options, TASK, None)

    def dense(self):
        return DiffusionPolicy.from_pretrained("assets/lift")

    def actor(self, name):
        return name

    def identity(self, name):
        return {"method": name, **self.settings}

    def measure(self, episodes):
        self.noted.append("measured")
        latency = summarize_latency([0.1, 0.1])
        return {name: MethodRun(played, latency, (0.0, 0.0)) for name, played in episodes.items()}

    def draw(self, results, episodes):
        assert load_results(self.out / "results.json") == results  # is there, whatever drawing does
        self.noted.append("drawn")


@pytest.fixture
def noted(monkeypatch):
    noted = []

    def evaluate(name, actor, make_env, seeds, *, log, identity, **options):
        noted.append((name, len(seeds), log.name, identity))
        return [EpisodeResult(seed, True, 20, 3, 9.0, 0.0) for seed in seeds]

    monkeypatch.setattr(benchmark, "evaluate", evaluate)
    monkeypatch.setattr(benchmark, "episode_horizon", lambda make_env, seeds: 40)
    return noted


def test_a_run_plays_dense_first_then_measures_compares_and_draws(noted, tmp_path):
    results = Noted(BenchmarkOptions.of(ASKED | {"out": tmp_path}), noted).run()
    how = {"task": "lift", "horizon": 40, "n_action_steps": 8}
    played = [(name, 3, f"{name}.jsonl", {"method": name, **how}) for name in ("dense", "fast")]
    assert noted == [*played, "measured", "drawn"]
    assert (results.task, results.first_seed, results.dense.success.n) == ("Lift", 100_005, 3)


def test_denses_episodes_may_lie_elsewhere(noted, tmp_path):
    Noted(BenchmarkOptions.of(ASKED | {"out": tmp_path, "dense_log": "shared.jsonl"}), noted).run()
    assert [call[2] for call in noted[:2]] == ["shared.jsonl", "fast.jsonl"]


def test_it_plays_until_it_is_decided(noted, tmp_path):
    asked = ASKED | {"out": tmp_path, "until": "conclusive", "max_episodes": 400}
    results = Noted(BenchmarkOptions.of(asked), noted).run()
    assert results.until_conclusive.max_episodes == 400
    assert results.methods["fast"].success.n < 400
