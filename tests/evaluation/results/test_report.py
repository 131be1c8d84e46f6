import math
from dataclasses import replace

import pytest

from tests.evaluation.synthetic import DENSE_FLOPS, MACHINE, POLICY, make_results, make_runs
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.report import (
    MethodRun,
    build_results,
    format_pairs,
    format_table,
)
from torchrl_sparse.evaluation.results.schema import (
    ActionError,
    Difference,
    Flops,
    Percentiles,
    Success,
    TokensKept,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.intervals import tango_interval, wilson_interval


def build(runs, **kwargs):
    return build_results(runs, task="lift", seed=3, machine=MACHINE, policy=POLICY, **kwargs)


def run(outcomes, *, queries=2, flops=10.0, latency=1.0, first_seed=0):
    episodes = [
        EpisodeResult(first_seed + i, bool(outcome), 30, queries, queries * flops, 0.25)
        for i, outcome in enumerate(outcomes)
    ]
    return MethodRun(episodes, summarize_latency([latency] * 5), (0.1, 0.4))


def test_build_computes_what_the_schema_promises():
    dense = run([1, 1, 1, 0] * 5)
    fast = run([1, 1, 0, 0] * 5, flops=2.0, latency=0.25)
    results = build({"dense": dense, "fast": fast}, margin=0.1)
    entry = results.methods["fast"]
    assert entry.success == Success(k=10, n=20, rate=0.5, ci95=wilson_interval(10, 20))
    assert entry.paired_vs_dense == Difference(-0.25, tango_interval(0, 5, 20), 0.1, "undecided")
    assert entry.flops == Flops(per_query=2.0, ratio_to_dense=0.2)
    assert entry.latency_s == Percentiles(0.25, 0.25, 5)
    assert entry.speedup_vs_dense == 4.0
    assert entry.action_error_vs_dense == ActionError(0.1, 0.4)
    assert entry.episode_length == 30
    assert (results.schema, results.seed) == (1, 3)


def test_visual_tokens_are_reported_where_there_are_any():
    blind, sighted = run([1, 0]), run([1, 1])
    kept = {"kept": (90.0, 30.0), "fine": (True, False)}
    sighted = replace(sighted, episodes=[replace(episode, **kept) for episode in sighted.episodes])
    results = build({"dense": sighted, "blind": blind})
    assert results.dense.tokens == TokensKept(kept_mean=60.0, kept_fine=90.0, kept_coarse=30.0)
    assert results.methods["blind"].tokens is None
    assert "60.0 (30 / 90)" in format_table(replace(results, methods={"dense": results.dense}))


def test_planning_is_reported_where_it_was_timed():
    planned = replace(run([1, 1], latency=0.01), planning=summarize_latency([2e-4, 3e-4, 4e-4]))
    results = build({"dense": run([1, 0]), "sag": planned})
    assert results.methods["sag"].planning_s.p50 == 3e-4
    assert results.dense.planning_s is None
    assert "Planning takes, of that and measured within queries, 0.3 ms (3.0 %) under sag." in format_table(
        results
    )
    assert "Planning takes" not in format_table(build({"dense": run([1, 0])}))


def test_any_two_methods_are_compared_seed_by_seed():
    won, lost = run([1, 1, 1, 0] * 5), run([1, 0, 0, 1] * 5)
    low, high = tango_interval(10, 5, 20)
    table = format_pairs({"a": won.episodes, "b": lost.episodes[::-1]}, [["a", "b"]], margin=0.05)
    assert f"15 : 10 | +25.0 [{100 * low:+.1f}, {100 * high:+.1f}]" in table
    with pytest.raises(ValueError, match=r"pairs: expected two of a, b, got \['a', 'c'\]"):
        format_pairs({"a": won.episodes, "b": lost.episodes}, [["a", "c"]])
    with pytest.raises(ValueError, match="expected the seeds of 'b'"):
        format_pairs({"a": won.episodes, "b": run([1], first_seed=9).episodes}, [["a", "b"]])


def test_dense_equals_itself_by_definition():
    assert make_results(10).dense.paired_vs_dense == Difference(0, (0, 0), 0.05, "non-inferior")


def test_pairing_goes_by_seed_not_by_order():
    dense = run([1, 1, 0, 0])
    shuffled = MethodRun(dense.episodes[::-1], dense.latency, (0.0, 0.0))
    results = build({"dense": dense, "same": shuffled})
    assert results.methods["same"].paired_vs_dense.ci95 == tango_interval(0, 0, 4)


def test_flops_average_over_queries_not_episodes():
    episodes = [EpisodeResult(0, True, 8, 1, 100.0, 0.0), EpisodeResult(1, True, 24, 3, 60.0, 0.8)]
    results = build({"dense": MethodRun(episodes, summarize_latency([1.0]), (0.0, 0.0))})
    assert results.dense.flops.per_query == 40.0
    assert results.dense.prune_rate == pytest.approx(0.6)
    assert results.dense.episode_length == 16.0


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (lambda: {"fast": run([1])}, "'dense'.*got \\['fast'\\]"),
        (lambda: {"dense": run([1, 1]), "fast": run([1, 1], first_seed=1)}, "fast: .*seeds.*\\[0, 2\\]"),
        (lambda: {"dense": run([1, 1]), "fast": run([1])}, "fast: .*seeds.*\\[1\\]"),
        (lambda: {"dense": run([1], queries=0)}, "at least one query"),
        (
            lambda: {"dense": MethodRun(run([1]).episodes * 2, run([1]).latency, (0, 0))},
            "one episode per seed",
        ),
        (
            lambda: {"dense": MethodRun(run([1]).episodes, run([1]).latency, (math.nan, 0))},
            "mean: expected a finite number",
        ),
    ],
)
def test_build_refuses(runs, message):
    with pytest.raises(ValueError, match=message):
        build(runs())


def test_table_is_markdown_with_aligned_columns():
    lines = format_table(make_results(100)).splitlines()
    table = lines[: lines.index("")]
    assert len(table) == 2 + 6
    assert len({len(line) for line in table}) == 1
    assert len({line.count("|") for line in table}) == 1
    assert set(table[1]) == set("|:-")
    dense = [cell.strip() for cell in table[2].strip("|").split("|")]
    header = [cell.strip() for cell in table[0].strip("|").split("|")]
    row = dict(zip(header, dense, strict=True))
    assert row["method"] == "dense"
    assert row["success"].startswith("98/100 [")
    assert row["GFLOPs/query"] == f"{DENSE_FLOPS / 1e9:.2f}"
    assert row["FLOPs ratio"] == "1.000"
    assert row["verdict"] == "baseline"


def test_table_says_when_episodes_cannot_suffice():
    assert "73 are needed" in format_table(make_results(50))
    assert "needed" not in format_table(make_results(100))


def test_table_covers_the_methods_that_ran():
    text = format_table(build(make_runs(30, names=("dense", "ddim10"))))
    assert "ddim10" in text
    assert "bac" not in text
