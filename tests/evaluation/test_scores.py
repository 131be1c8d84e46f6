"""Scores of episodes: means and paired differences as scipy's tests have them, from the logs beside results."""

import numpy as np
import pytest
from scipy.stats import norm, ttest_1samp, ttest_rel

from recipes.studies.pages.page_rows import read_table
from recipes.studies.pages.scores import score_rows, told_scores
from tests.evaluation.synthetic import MACHINE, POLICY, make_results
from tests.refusals import refused
from torchrl_sparse.evaluation.benchmarks.rounds import play_rounds
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.acceleration import Played
from torchrl_sparse.evaluation.results.build import MethodRun, Terms, build_results
from torchrl_sparse.evaluation.results.report import format_table, results_rows
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.statistics.scores import difference_interval, difference_z, mean_interval
from torchrl_sparse.evaluation.statistics.sequential import Design


def test_intervals_are_those_of_the_t_tests():
    ours, theirs = np.random.default_rng(0).random((2, 12))
    assert mean_interval(ours) == (ours.mean(), pytest.approx([*ttest_1samp(ours, 0).confidence_interval()]))
    paired = ttest_rel(ours, theirs).confidence_interval()
    assert difference_interval(ours, theirs)[1] == pytest.approx([*paired])


def test_one_number_has_no_interval():
    with refused("values"):
        mean_interval([0.5])
    with refused("pairs"):
        difference_interval([0.5], [0.4])


def test_methods_are_compared_on_the_seeds_of_both():
    dense = {seed: 0.5 + 0.01 * seed for seed in range(20)}
    fast = {seed: dense[seed] - 0.2 + 0.001 * (seed % 2) for seed in range(5, 15)}
    baseline, row, other = score_rows({"dense": dense, "fast": fast, "same": {0: 0.5, 1: 0.51}}, 0.05)
    assert baseline["verdict"] == "baseline"
    assert row["episodes"] == "10"
    assert row["vs dense, points"].startswith("-20.0 [-20.0, ")
    assert row["verdict"] == "inferior"
    assert other["verdict"] == "non-inferior"


def test_a_page_reads_them_from_the_episodes_beside_its_results(tmp_path):
    save_results(make_results(4, names=("dense", "ddim10")), tmp_path / "results.json")
    for name in ("dense", "ddim10"):
        log = EpisodeLog(tmp_path / "episodes" / f"{name}.jsonl")
        for seed in range(100_000, 100_005):  # the last is not of these results
            log.append(EpisodeResult(seed, False, 30, 4, 1e9, 0.0, score=seed % 3 / 2))
    rows = read_table(tmp_path / "results.json", "scores").rows
    assert [row["episodes"] for row in rows] == ["4", "4"]
    plain = [EpisodeResult(0, True, 30, 4, 1e9, 0.0)]
    assert told_scores({"other": plain}) == {}


def test_a_page_that_asks_for_scores_of_a_task_without_is_told(tmp_path):
    save_results(make_results(4, names=("dense",)), tmp_path / "results.json")
    EpisodeLog(tmp_path / "episodes" / "dense.jsonl").append(EpisodeResult(100_000, True, 30, 4, 1e9, 0.0))
    with refused("rows"):
        read_table(tmp_path / "results.json", "scores")


def scored(mean, count=60, solved=False):
    """Episodes of a task that hardly anybody solves, whose scores scatter around a mean."""
    scores = np.clip(np.random.default_rng(int(100 * mean)).normal(mean, 0.1, count), 0, 1)
    return [EpisodeResult(seed, solved, 60, 3, 30.0, 0.0, score=score) for seed, score in enumerate(scores)]


def test_a_task_that_is_graded_is_judged_by_its_scores(tmp_path):
    runs = {
        name: MethodRun(scored(mean), summarize_latency([1.0] * 5), (0.1, 0.4))
        for name, mean in {"dense": 0.7, "same": 0.74, "worse": 0.4}.items()
    }
    results = build_results(
        runs,
        task="PushT",
        split="development",
        seed=0,
        terms=Terms(Design(60), 60, graded=True),
        machine=MACHINE,
        policy=POLICY,
        pairs=[["worse", "same"]],
    )
    save_results(results, tmp_path / "results.json")
    assert load_results(tmp_path / "results.json") == results
    worse, same = Played.of(results.methods["worse"]), Played.of(results.methods["same"])
    assert worse.paired_vs_dense.verdict == "inconclusive"  # nothing was solved, and nothing lost by that
    assert worse.verdicts == {"the score": "inferior"}
    assert (same.is_right, worse.is_right) == (True, False)
    assert worse.score.vs_dense.ci95 == pytest.approx(paired_t_test(runs["worse"], runs["dense"]))
    assert worse.score.p_value < 0.001
    row = results_rows(results)[2]
    assert row["verdict"] == "inferior"
    assert "time vs dense" not in row
    assert "2 comparisons with dense" in format_table(results)
    (pair,) = results.pairs
    assert pair.score.ci95 == pytest.approx(paired_t_test(runs["worse"], runs["same"]))
    (told,) = read_table(tmp_path / "results.json", "pairs").rows
    assert (told["success"], told["verdict"]) == ("0 : 0", "inferior")
    assert told["difference, points"].startswith("-36.0 [")
    assert "time ratio" not in told


def paired_t_test(ours, theirs):
    pairs = zip(ours.episodes, theirs.episodes, strict=True)
    return [*ttest_1samp([ours.score - theirs.score for ours, theirs in pairs], 0).confidence_interval()]


def test_episodes_of_such_a_task_go_on_until_the_score_is_decided():
    played = {"dense": scored(0.7, 300), "far": scored(0.4, 300), "close": scored(0.665, 300)}
    terms = Terms(Design(300, 30), 60, graded=True)
    episodes = play_rounds(["far", "close"], lambda name, count: played[name][:count], terms)
    assert len(episodes["far"]) < 100
    assert difference_z([0.5], [0.5], -0.05) == 0  # one pair says nothing


@pytest.mark.parametrize("n", [3, 10, 200])
def test_a_score_is_decided_where_its_interval_says_so(n):
    ours, theirs = np.random.default_rng(n).normal(0.0, 0.1, (2, n))
    for confidence in (0.9, 0.95, 0.999):
        low, high = difference_interval(ours, theirs, confidence)[1]
        assert difference_z(ours, theirs, low) == pytest.approx(norm.ppf((1 + confidence) / 2))
        assert difference_z(ours, theirs, high) == pytest.approx(-norm.ppf((1 + confidence) / 2))
