"""Scores of episodes: means and paired differences as scipy's tests have them, from the logs beside results."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_rel

from tests.evaluation.synthetic import make_results
from torchrl_sparse.evaluation.results.page_rows import read_table
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.scores import score_rows, told_scores
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.evaluation.statistics.scores import mean_interval


def test_intervals_are_those_of_the_t_tests():
    ours, theirs = np.random.default_rng(0).random((2, 12))
    assert mean_interval(ours) == (ours.mean(), pytest.approx([*ttest_1samp(ours, 0).confidence_interval()]))
    paired = ttest_rel(ours, theirs).confidence_interval()
    assert mean_interval(ours - theirs)[1] == pytest.approx([*paired])


def test_one_number_has_no_interval():
    with pytest.raises(ValueError, match=r"values: expected at least two numbers, got shape \(1,\)"):
        mean_interval([0.5])


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
    with pytest.raises(ValueError, match="rows: expected episodes of lift with scores, got none"):
        read_table(tmp_path / "results.json", "scores")
