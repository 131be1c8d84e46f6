"""Which test is used follows from what the episodes have in common; nothing is dropped without a word."""

import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes, Outcome, Start
from torchrl_sparse.evaluation.compare.page import verdict_notes, verdict_rows, write_verdicts
from torchrl_sparse.evaluation.compare.planning import pilot_truths
from torchrl_sparse.evaluation.compare.verdicts import compare_methods
from torchrl_sparse.evaluation.statistics.durations import time_ratio
from torchrl_sparse.evaluation.statistics.intervals import paired_difference


def method(name, solved, first=0, kind="seed", steps=None, task="lift"):
    starts = [Start(task, kind, first + index) if kind else None for index in range(len(solved))]
    took = [None] * len(solved) if steps is None else steps
    outcomes = [Outcome(*one) for one in zip(starts, map(bool, solved), took, strict=True)]
    return MethodOutcomes(name, f"{name}.csv", outcomes)


def draw(rate, n, seed):
    return np.random.default_rng(seed).random(n) < rate


A, B = draw(0.9, 200, 0), draw(0.8, 200, 1)


def test_the_same_seeds_are_pairs_whatever_their_order():
    shuffled = MethodOutcomes("b", "b.csv", method("b", B).outcomes[::-1])
    (one,) = compare_methods([method("a", A), shuffled]).comparisons
    assert (one.design, one.success) == ("paired", paired_difference(B, A).__class__(**vars(one.success)))
    expected = paired_difference(B, A)
    assert (one.success.ci95, one.p_equal) == (expected.ci95, expected.mcnemar_p)


def test_some_shared_seeds_and_none():
    (partly,) = compare_methods([method("a", A), method("b", B, first=50)]).comparisons
    assert (partly.design, partly.counts.pairs, partly.counts.ours[1]) == ("partly paired", 150, 50)
    (apart,) = compare_methods([method("a", A), method("b", B, first=1000)]).comparisons
    assert (apart.design, apart.success.diff) == ("unpaired", pytest.approx(B.mean() - A.mean()))
    (nameless,) = compare_methods([method("a", A), method("b", B, kind=None)]).comparisons
    assert nameless.success == apart.success


def test_seeds_and_places_do_not_pair_and_it_is_said():
    verdicts = compare_methods([method("a", A), method("b", B, kind="index")])
    assert verdicts.comparisons[0].design == "unpaired"
    assert any("no pair in common" in note for note in verdict_notes(verdicts))


def test_methods_of_other_tasks_are_refused():
    with refused("b.csv"):
        compare_methods([method("a", A), method("b", B, task="can")])
    with refused("files"):
        compare_methods([method("a", A)])
    with refused("reference"):
        compare_methods([method("a", A), method("b", B)], reference="c")


def test_times_are_compared_where_all_tell_them():
    slow, fast = (np.where(A, took, 400).tolist() for took in (60, 30))
    (one,) = compare_methods([method("a", A, steps=fast), method("b", A, steps=slow)]).comparisons
    expected = time_ratio(slow, fast, 400)
    assert (one.time, one.time.verdict) == (expected, "inferior")
    (untold,) = compare_methods([method("a", A, steps=fast), method("b", A)]).comparisons
    assert untold.time is None
    given_up = np.where(A, 30, 120).tolist()
    assert (
        compare_methods([method("a", A, steps=fast), method("b", A, steps=given_up)]).comparisons[0].time
        is None
    )
    with refused("horizon"):
        compare_methods([method("a", A, steps=fast), method("b", A, steps=given_up)], horizon=400)


def test_nothing_is_decided_where_nothing_is_solved():
    (one,) = compare_methods([method("a", [0] * 300), method("b", [0] * 300)]).comparisons
    assert (one.success.verdict, one.p_value) == ("inconclusive", 0.5)


def test_the_best_are_those_that_none_beats():
    methods = [
        method("good", draw(0.95, 300, 2)),
        method("as_good", draw(0.95, 300, 3)),
        method("bad", draw(0.5, 300, 4)),
    ]
    verdicts = compare_methods(methods, reference="as_good")
    assert verdicts.best == ["good", "as_good"]
    assert "good, as_good" in verdict_notes(verdicts)[-1]
    assert [row["method"] for row in verdict_rows(verdicts)] == ["as_good", "good", "bad"]
    assert "bad success" in verdicts.lasting


@pytest.mark.full
def test_the_best_is_among_them_as_often_as_is_said():
    kept = 0
    for trial in range(200):
        methods = [method(str(i), draw(0.8, 60, 10 * trial + i)) for i in range(4)]
        kept += len(compare_methods(methods).best) == 4
    assert kept / 200 >= 0.93


def test_the_page_has_everything_and_asks_for_nothing(tmp_path):
    verdicts = compare_methods([method("a<b>", A), method("b", B, first=50)])
    page = write_verdicts(verdicts, ["a.csv", "b.csv"], tmp_path / "page.html", title="mine").read_text()
    assert "a&lt;b&gt;" in page
    assert "partly paired: 150 pairs, 50 and 50 alone" in page
    assert 'src="data:image/png' in page
    assert 'src="http' not in page


def test_a_pilot_tells_rate_and_correlation():
    ((name, truth),) = pilot_truths([method("a", A), method("b", A)])
    assert (name, truth.correlation) == ("b", 0.999)
    assert truth.success == pytest.approx((2 * A.sum() + 1) / 402)
    ((_, sure),) = pilot_truths([method("a", [1] * 20), method("b", [1] * 20)])
    assert (sure.success, sure.correlation) == (41 / 42, 0.0)
    with refused("files"):
        pilot_truths([method("a", A)])
