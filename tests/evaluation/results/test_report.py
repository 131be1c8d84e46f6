import copy
import json
import math
import os
from dataclasses import replace

import pytest

from tests.evaluation.synthetic import DENSE_FLOPS, MACHINE, POLICY, make_results, make_runs
from torchrl_sparse.evaluation.latency.measure import summarize_latency
from torchrl_sparse.evaluation.results.report import (
    MethodRun,
    build_results,
    format_pairs,
    format_table,
    load_results,
    save_results,
)
from torchrl_sparse.evaluation.results.schema import validate_results
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
    entry = results["methods"]["fast"]
    assert entry["success"] == {"k": 10, "n": 20, "rate": 0.5, "ci95": list(wilson_interval(10, 20))}
    assert entry["paired_vs_dense"] == {
        "diff": -0.25,
        "ci95": list(tango_interval(0, 5, 20)),
        "margin": 0.1,
        "verdict": "undecided",
    }
    assert entry["flops"] == {"per_query": 2.0, "ratio_to_dense": 0.2}
    assert entry["latency_s"] == {"p50": 0.25, "p95": 0.25, "n": 5}
    assert entry["speedup_vs_dense"] == 4.0
    assert entry["action_error_vs_dense"] == {"mean": 0.1, "max": 0.4}
    assert entry["episode_length"] == 30
    assert results["schema"] == 1
    assert results["seed"] == 3


def test_visual_tokens_are_reported_where_there_are_any():
    blind, sighted = run([1, 0]), run([1, 1])
    kept = {"kept": (90.0, 30.0), "fine": (True, False)}
    sighted = replace(sighted, episodes=[replace(episode, **kept) for episode in sighted.episodes])
    results = build({"dense": sighted, "blind": blind})
    assert results["methods"]["dense"]["tokens"] == {
        "kept_mean": 60.0,
        "kept_fine": 90.0,
        "kept_coarse": 30.0,
    }
    assert "tokens" not in results["methods"]["blind"]
    assert "60.0 (30 / 90)" in format_table({**results, "methods": {"dense": results["methods"]["dense"]}})
    results["methods"]["dense"]["tokens"]["kept_fine"] = None
    validate_results(results)
    results["methods"]["dense"]["tokens"]["kept_fine"] = "many"
    with pytest.raises(ValueError, match=r"methods.dense.tokens.kept_fine: expected a finite number or null"):
        validate_results(results)


def test_planning_is_reported_where_it_was_timed():
    planned = replace(run([1, 1], latency=0.01), planning=summarize_latency([2e-4, 3e-4, 4e-4]))
    results = build({"dense": run([1, 0]), "sag": planned})
    assert results["methods"]["sag"]["planning_s"]["p50"] == 3e-4
    assert "planning_s" not in results["methods"]["dense"]
    assert "Planning takes, of that and measured within queries, 0.3 ms (3.0 %) under sag." in format_table(
        results
    )
    assert "Planning takes" not in format_table(build({"dense": run([1, 0])}))
    results["methods"]["sag"]["planning_s"]["p50"] = 0.0
    with pytest.raises(ValueError, match=r"methods.sag.planning_s: expected 0 < p50 <= p95"):
        validate_results(results)


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
    paired = make_results(10)["methods"]["dense"]["paired_vs_dense"]
    assert paired["diff"] == 0
    assert paired["ci95"] == [0, 0]
    assert paired["verdict"] == "non-inferior"


def test_pairing_goes_by_seed_not_by_order():
    dense = run([1, 1, 0, 0])
    shuffled = MethodRun(dense.episodes[::-1], dense.latency, (0.0, 0.0))
    results = build({"dense": dense, "same": shuffled})
    assert results["methods"]["same"]["paired_vs_dense"]["ci95"] == list(tango_interval(0, 0, 4))


def test_flops_average_over_queries_not_episodes():
    episodes = [EpisodeResult(0, True, 8, 1, 100.0, 0.0), EpisodeResult(1, True, 24, 3, 60.0, 0.8)]
    results = build({"dense": MethodRun(episodes, summarize_latency([1.0]), (0.0, 0.0))})
    assert results["methods"]["dense"]["flops"]["per_query"] == 40.0
    assert results["methods"]["dense"]["prune_rate"] == pytest.approx(0.6)
    assert results["methods"]["dense"]["episode_length"] == 16.0


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
            "action_error.*finite",
        ),
    ],
)
def test_build_refuses(runs, message):
    with pytest.raises(ValueError, match=message):
        build(runs())


def test_round_trip(tmp_path):
    results = make_results(20)
    path = save_results(results, tmp_path / "deep" / "results.json")
    assert load_results(path) == results
    assert os.listdir(path.parent) == ["results.json"]


def test_failed_save_keeps_the_old_file(tmp_path):
    path = save_results(make_results(20), tmp_path / "results.json")
    before = path.read_bytes()
    broken = make_results(20)
    broken["seed"] = "zero"
    with pytest.raises(ValueError, match="seed"):
        save_results(broken, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["results.json"]


FAULTS = {
    "schema": (("schema",), 2, "schema: expected 1, got 2"),
    "boolean integer": (("seed",), True, "seed: expected an integer, got True"),
    "float integer": (("machine", "threads"), 1.0, "machine.threads: expected an integer, got 1.0"),
    "number for text": (("task",), 7, "task: expected a string, got 7"),
    "nan": (
        ("methods", "bac", "prune_rate"),
        math.nan,
        "methods.bac.prune_rate: expected a finite number, got nan",
    ),
    "rate": (("methods", "bac", "success", "rate"), 0.5, "methods.bac.success.rate: expected k / n"),
    "k beyond n": (("methods", "bac", "success", "k"), 21, "methods.bac.success.k: expected 0 to 20, got 21"),
    "other n": (("methods", "bac", "success", "n"), 0, "methods.bac.success.n: expected at least 1"),
    "reversed interval": (("methods", "bac", "success", "ci95"), [0.9, 0.1], "ci95: expected .low, high."),
    "short interval": (("methods", "bac", "paired_vs_dense", "ci95"), [0.9], "paired_vs_dense.ci95"),
    "verdict": (
        ("methods", "bac", "paired_vs_dense", "verdict"),
        "fine",
        "verdict: expected one of .*got 'fine'",
    ),
    "percentiles": (("methods", "bac", "latency_s", "p95"), 1e-9, "latency_s: expected 0 < p50 <= p95"),
    "negative flops": (
        ("methods", "bac", "flops", "per_query"),
        -1.0,
        "methods.bac.flops: expected values >= 0",
    ),
    "no object": (("machine",), "fast", "machine: expected an object, got 'fast'"),
    "prune rate": (("methods", "bac", "prune_rate"), 90, "methods.bac.prune_rate: expected 0 to 1, got 90"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_validation_names_path_expected_and_got(name):
    path, value, message = FAULTS[name]
    results = make_results(20)
    target = results
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(ValueError, match=message):
        validate_results(results)


def test_missing_and_unknown_keys():
    results = make_results(20)
    missing = copy.deepcopy(results)
    del missing["methods"]["bac"]["flops"]["ratio_to_dense"]
    with pytest.raises(ValueError, match=r"methods.bac.flops.ratio_to_dense: expected this key"):
        validate_results(missing)
    unknown = copy.deepcopy(results)
    unknown["policy"]["params_m"] = 9
    with pytest.raises(ValueError, match=r"policy: expected only the keys .* got .*params_m"):
        validate_results(unknown)
    without = copy.deepcopy(results)
    del without["methods"]["dense"]
    with pytest.raises(ValueError, match="methods: expected the key 'dense'"):
        validate_results(without)
    with pytest.raises(ValueError, match="results: expected an object"):
        validate_results([1, 2])


def test_load_names_the_file(tmp_path):
    path = tmp_path / "results.json"
    path.write_text('{"schema": 1')
    with pytest.raises(ValueError, match=r"results.json"):
        load_results(path)
    path.write_text(json.dumps({"schema": 9}))
    with pytest.raises(ValueError, match=r"results.json: schema: expected 1, got 9"):
        load_results(path)


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
    assert row["verdict"] == "reference"


def test_table_says_when_episodes_cannot_suffice():
    assert "73 are needed" in format_table(make_results(50))
    assert "needed" not in format_table(make_results(100))


def test_table_covers_the_methods_that_ran():
    text = format_table(build(make_runs(30, names=("dense", "ddim10"))))
    assert "ddim10" in text
    assert "bac" not in text
