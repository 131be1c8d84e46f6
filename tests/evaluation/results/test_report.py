import math
from dataclasses import replace

import pytest

from recipes.studies.pages.page_rows import read_table
from tests.evaluation.synthetic import DENSE_FLOPS, MACHINE, POLICY, make_results
from tests.refusals import refused
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.build import MethodRun, Terms, build_results
from torchrl_sparse.evaluation.results.parts import ActionError, Flops, Percentiles, Success
from torchrl_sparse.evaluation.results.report import format_table, results_rows
from torchrl_sparse.evaluation.results.schema import load_results, save_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, TokensKept
from torchrl_sparse.evaluation.statistics.differences import Difference
from torchrl_sparse.evaluation.statistics.durations import time_ratio
from torchrl_sparse.evaluation.statistics.intervals import tango_interval, wilson_interval
from torchrl_sparse.evaluation.statistics.sequential import Design

ABOUT = {"task": "lift", "split": "test", "seed": 3, "machine": MACHINE, "policy": POLICY}


def build(runs, design=None, **kwargs):
    design = Design(len(next(iter(runs.values())).episodes)) if design is None else design
    return build_results(runs, terms=Terms(design, 60, early_cut=30, **kwargs), **ABOUT)


def run(outcomes, *, queries=2, flops=10.0, latency=1.0, first_seed=0):
    episodes = [
        EpisodeResult(first_seed + i, bool(outcome), 30 if outcome else 60, queries, queries * flops, 0.25)
        for i, outcome in enumerate(outcomes)
    ]
    return MethodRun(episodes, summarize_latency([latency] * 5), (0.1, 0.4))


def test_build_computes_what_the_schema_promises():
    dense = run([1, 1, 1, 0] * 5)
    fast = run([1, 1, 0, 0] * 5, flops=2.0, latency=0.25)
    results = build({"dense": dense, "fast": fast}, margin=0.1)
    entry = results.methods["fast"]
    assert entry.success == Success(k=10, n=20, rate=0.5, ci95=wilson_interval(10, 20))
    assert entry.paired_vs_dense == Difference(-0.25, tango_interval(0, 5, 20), 0.1, "inconclusive", 0.0625)
    assert entry.flops == Flops(per_query=2.0, ratio_to_dense=0.2)
    assert entry.latency_s == Percentiles(0.25, 0.25, 5)
    assert entry.speedup_vs_dense == 4.0
    assert entry.action_error_vs_dense == ActionError(0.1, 0.4)
    assert entry.episode_length == entry.restricted_mean_time == 45
    assert entry.time_vs_dense.ratio == 45 / 37.5
    assert entry.success_within["30"] == 0.5
    assert max(share for steps, share in entry.success_within.items() if int(steps) < 30) == 0
    assert entry.speedup_ci95 == (4.0, 4.0)
    assert (results.schema, results.split, results.seed, results.first_seed) == (2, "test", 3, 210_003)


def test_where_methods_are_not_asked_equally_often_an_episode_says_what_they_cost():
    dense, often = run([1] * 20), replace(run([1] * 20, queries=8, flops=2.0), every=2)
    results = build({"dense": dense, "fast_every2": often})
    assert results.methods["fast_every2"].per_episode.flops_per_step_to_dense == 0.8
    assert [row["a second"] for row in results_rows(results)] == ["1.000", "0.800"]
    assert "a second" not in results_rows(build({"dense": dense}))[0]


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
    assert (
        "Planning takes, of that and measured within policy calls, 0.3 ms (3.0 %) under sag."
        in format_table(results)
    )
    assert "Planning takes" not in format_table(build({"dense": run([1, 0])}))


def test_any_two_methods_are_compared_seed_by_seed():
    won, lost = run([1, 1, 1, 0] * 5), run([1, 0, 0, 1] * 5)
    low, high = tango_interval(10, 5, 20)
    runs = {"dense": won, "a": won, "b": replace(lost, episodes=lost.episodes[::-1])}
    terms = Terms(Design(20), 60, early_cut=30)
    table = format_table(build_results(runs, terms=terms, pairs=[["a", "b"]], **ABOUT))
    assert f"15 : 10 | +25.0 [{100 * low:+.1f}, {100 * high:+.1f}]" in " ".join(table.split())
    with refused("pairs"):
        build_results(runs, terms=terms, pairs=[["a", "c"]], **ABOUT)


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
    ("runs", "entry"),
    [
        (lambda: {"fast": run([1])}, "runs"),
        (lambda: {"dense": run([1, 1]), "fast": run([1, 1], first_seed=1)}, "fast"),
        (lambda: {"dense": run([1, 1]), "fast": run([1])}, "fast"),
        (lambda: {"dense": run([1], queries=0)}, "episodes"),
        (
            lambda: {"dense": MethodRun(run([1]).episodes * 2, run([1]).latency, (0, 0))},
            "episodes",
        ),
        (
            lambda: {"dense": MethodRun(run([1]).episodes, run([1]).latency, (math.nan, 0))},
            "mean",
        ),
    ],
)
def test_build_refuses(runs, entry):
    with refused(entry):
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


def test_what_the_engine_executes_stands_beside_the_published_count():
    runs = {
        "dense": replace(run([1] * 20), executed_flops=8e9),
        "bac": replace(run([1] * 20), executed_flops=2e9),
    }
    counted = build(runs)
    rows = results_rows(counted)
    assert [row["executed, GFLOPs"] for row in rows] == ["8.00", "2.00"]
    assert "what the engine executes" in format_table(counted)
    uncounted = make_results(100)
    assert "executed, GFLOPs" not in results_rows(uncounted)[0]
    assert "what the engine executes" not in format_table(uncounted)


def test_table_says_when_episodes_cannot_suffice():
    assert "73 are needed" in format_table(make_results(50))
    assert "needed" not in format_table(make_results(100))


def test_table_says_when_dense_solved_none():
    none = {"dense": run([False] * 4), "bac": run([False] * 4)}
    assert "Dense solved none" in format_table(build(none))
    assert "Dense solved none" not in format_table(
        build({"dense": run([False, True]), "bac": run([False] * 2)})
    )


def test_table_covers_the_methods_that_ran():
    text = format_table(make_results(30, names=("dense", "ddim10")))
    assert "ddim10" in text
    assert "bac" not in text


def test_a_method_that_stopped_is_compared_on_its_own_seeds_at_the_level_of_its_analysis():
    design = Design(40, analyses=2)
    dense, slow = run([1, 1, 1, 0] * 10), run([1, 0, 1, 0] * 5)
    results = build({"dense": dense, "slow": slow}, design)
    entry, level = results.methods["slow"], design.confidence(20)
    assert level > 0.95
    assert (entry.success.n, results.dense.success.n) == (20, 40)
    assert entry.paired_vs_dense.ci95 == tango_interval(0, 5, 20, level)
    ours, theirs = [30, 60, 30, 60] * 5, [30, 30, 30, 60] * 5
    assert entry.time_vs_dense.ci95 == time_ratio(ours, theirs, 60, confidence=level).ci95
    assert "with 2 interim analyses up to 40" in format_table(results)


def test_worse_is_said_whatever_the_margin():
    dense, worse = run([1] * 400), run([0] * 8 + [1] * 392)
    rows = results_rows(build({"dense": dense, "worse": worse}))
    assert rows[1]["verdict"] == "non-inferior, worse"
    assert rows[0]["verdict"] == "baseline"


def test_a_verdict_that_many_comparisons_explain_is_marked():
    dense = run([1, 0] * 200)
    close = run([1, 0] * 191 + [0, 0] * 9)
    many = {"dense": dense, "close": close} | {
        f"other{index}": run([1, 0, 0, 1] * 100) for index in range(30)
    }
    alone = results_rows(build({"dense": dense, "close": close}))[1]
    among = results_rows(build(many))[1]
    assert alone["verdict"].startswith("non-inferior")
    assert among["verdict"] == alone["verdict"].replace("non-inferior", "non-inferior†", 1)
    assert "62 comparisons with dense" in format_table(build(many))


def test_an_episode_of_more_queries_costs_more_of_them():
    """A fifth of the FLOPs a policy call is saved; of an episode, which is twice as long, more than dense's are spent."""
    dense = [EpisodeResult(i, True, 20, 5, 5 * 100.0, 0.0, kept=(8.0,) * 5) for i in range(4)]
    pruned = [EpisodeResult(i, True, 40, 10, 10 * 80.0, 0.5, kept=(4.0,) * 10) for i in range(4)]
    runs = {
        "dense": MethodRun(dense, summarize_latency([1.0, 1.0]), (0.0, 0.0)),
        "pruned": MethodRun(pruned, summarize_latency([0.9, 0.3]), (0.0, 0.0)),
    }
    results = build(runs)
    cost = results.methods["pruned"].per_episode
    assert (cost.queries, cost.flops, cost.flops_per_step) == (10, 800, 20)
    assert (cost.flops_to_dense, cost.flops_per_step_to_dense) == (1.6, 0.8)
    assert cost.seconds == pytest.approx(6.0)  # of the mean of what was timed
    assert cost.seconds_to_dense == pytest.approx(1.2)
    row = results_rows(results)[1]
    assert [row[name] for name in ("an episode", "a second", "queries")] == ["1.600", "0.800", "10.0"]
    assert build({"dense": run([1, 0])}).dense.per_episode is None


def test_pairs_are_part_of_the_file(tmp_path):
    dense, fast, slow = run([1] * 20), run([1, 1, 1, 0] * 5), run([1, 0, 0, 0] * 5)
    runs = {"dense": dense, "fast": fast, "slow": slow}
    results = build_results(
        runs,
        terms=Terms(Design(20), 60),
        pairs=[["fast", "slow"]],
        settings={"numbers": {"slow": 0.5}},
        **ABOUT,
    )
    save_results(results, tmp_path / "results.json")
    found = load_results(tmp_path / "results.json")
    assert found == results
    (pair,) = found.pairs
    assert (pair.solved, pair.n, pair.success.diff) == ((15, 5), 20, 0.5)
    assert pair.time.ratio == pytest.approx((15 * 30 + 5 * 60) / (5 * 30 + 15 * 60))
    table = read_table(tmp_path / "results.json", "pairs")
    assert (table.rows[0]["success"], table.rows[0]["against"]) == ("15 : 5", "slow")
    assert "| fast     | slow      |    15 : 5 |" in format_table(found)
    with refused("pairs"):
        build_results(runs, terms=Terms(Design(20), 60), pairs=[["fast", "sag"]], **ABOUT)
