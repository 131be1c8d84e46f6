"""Which method a table says to take: within a time of a policy call, and at twenty times dense's speed."""

from dataclasses import replace

import pytest

from recipes.studies.pages.choices import (
    best_within,
    budget_rows,
    headline,
    headline_rows,
)
from tests.evaluation.synthetic import make_results
from torchrl_sparse.evaluation.results.parts import PValues


def change(results, **changes):
    """The results with some fields of some methods replaced: name -> fields."""
    methods = {name: replace(method, **changes.get(name, {})) for name, method in results.methods.items()}
    return replace(results, methods=methods)


def judged(method, success, time, ratio=1.0):
    """Fields that give a method these verdicts, and this ratio of times."""
    return {
        "paired_vs_dense": replace(method.paired_vs_dense, verdict=success),
        "time_vs_dense": replace(method.time_vs_dense, verdict=time, ratio=ratio),
    }


@pytest.fixture
def results():
    """Dense, and two methods of 7 and 10 times its speed that are non-inferior in both."""
    made = make_results(50, names=("dense", "ddim10", "bac"))
    good = {name: judged(made.methods[name], "non-inferior", "non-inferior") for name in ("ddim10", "bac")}
    speed = {"ddim10": {"speedup_vs_dense": 10.0}, "bac": {"speedup_vs_dense": 7.0}}
    return change(made, **{name: good[name] | speed[name] for name in good})


def test_the_fastest_that_is_non_inferior_in_both_is_named(results):
    name, remark = headline(results, goal=9)
    assert name == "ddim10"
    assert remark.startswith("as fast as asked for, 9×")
    slow = change(results, ddim10=judged(results.methods["ddim10"], "non-inferior", "inconclusive"))
    assert headline(slow, goal=9) == ("bac", "ddim10, 10.0×, is inconclusive in time")
    assert headline(slow, goal=20) == ("bac", "no method is 20× as fast")


def test_it_says_which_verdict_does_not_survive_a_correction_for_all(results):
    for success, time, said in (
        (1e-6, 1e-6, ""),
        (1e-6, 0.02, "; in time not after Holm's correction for 4 comparisons"),
        (0.02, 0.02, "; in success and time not after Holm's correction for 4 comparisons"),
    ):
        tested = change(results, ddim10={"p_values": PValues(success, time)})
        assert headline(tested, goal=9) == ("ddim10", f"as fast as asked for, 9×{said}")


def test_without_one_it_says_what_the_nearest_lacks(results):
    worse = change(
        results,
        ddim10=judged(results.methods["ddim10"], "inconclusive", "inferior", ratio=1.5),
        bac=judged(results.methods["bac"], "inconclusive", "inconclusive", ratio=1.2),
    )
    assert headline(worse, goal=9) == (None, "ddim10, 10.0×, is inconclusive in success and inferior in time")
    assert headline(worse, goal=5) == (None, "bac, 7.0×, is inconclusive in success and inconclusive in time")
    (row,) = headline_rows(worse)
    assert row["method"] == "none"
    assert set(row) == set(headline_rows(results)[0])


def test_dense_itself_is_no_answer(results):
    alone = replace(results, methods={"dense": results.methods["dense"]})
    assert headline(alone, goal=0.5) == (None, "no method is 0.5× as fast")


def test_within_a_time_the_one_that_succeeds_soonest_is_taken(results):
    latency = {name: method.latency_s.p50 for name, method in results.methods.items()}
    assert latency["ddim10"] < latency["bac"] < latency["dense"]
    ratios = change(
        results,
        ddim10=judged(results.methods["ddim10"], "non-inferior", "non-inferior", ratio=1.05),
        bac=judged(results.methods["bac"], "non-inferior", "non-inferior", ratio=1.02),
    )
    assert best_within(ratios, latency["ddim10"] / 2) is None
    assert best_within(ratios, latency["ddim10"]) == "ddim10"
    assert best_within(ratios, latency["bac"]) == "bac"
    assert best_within(ratios, latency["dense"]) == "dense"
    rows = budget_rows(ratios)
    assert [row["budget, ms"] for row in rows] == ["1.5", "3", "5", "10", "30"]
    assert {row["method"] for row in rows} == {"none"}
