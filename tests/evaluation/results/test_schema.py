"""What a `results.json` may hold, and in which words everything else is refused."""

import copy
import json
import math
import os
from dataclasses import replace

import pytest

from tests.evaluation.synthetic import make_results
from torchrl_sparse.evaluation.results.schema import Results, Stopping, load_results, save_results
from torchrl_sparse.storage.json import parse_json, to_plain


def read(content):
    return parse_json(json.dumps(content), Results, "results.json")


def test_round_trip(tmp_path):
    results = make_results(20)
    path = save_results(results, tmp_path / "deep" / "results.json")
    assert load_results(path) == results
    assert os.listdir(path.parent) == ["results.json"]


def test_failed_save_keeps_the_old_file(tmp_path):
    path = save_results(make_results(20), tmp_path / "results.json")
    before = path.read_bytes()
    with pytest.raises(ValueError, match="seed"):
        save_results(replace(make_results(20), seed="zero"), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["results.json"]


FAULTS = {
    "schema": (("schema",), 1, "schema: expected 2, got 1"),
    "boolean integer": (("seed",), True, "seed: expected a valid integer, got True"),
    "float integer": (("machine", "threads"), 1.0, "machine.threads: expected a valid integer, got 1.0"),
    "number for text": (("task",), 7, "task: expected a valid string, got 7"),
    "nan": (("methods", "bac", "prune_rate"), math.nan, "expected a complete JSON file"),
    "rate": (("methods", "bac", "success", "rate"), 0.5, "methods.bac.success.rate: expected k / n"),
    "k beyond n": (("methods", "bac", "success", "k"), 21, "methods.bac.success.k: expected 0 to 20, got 21"),
    "no episodes": (("methods", "bac", "success", "n"), 0, "methods.bac.success.n: expected at least 1"),
    "reversed interval": (("methods", "bac", "success", "ci95"), [0.9, 0.1], "ci95: expected low <= high"),
    "short interval": (("methods", "bac", "paired_vs_dense", "ci95"), [0.9], "paired_vs_dense.ci95"),
    "verdict": (
        ("methods", "bac", "paired_vs_dense", "verdict"),
        "fine",
        "verdict: expected 'non-inferior', 'inferior' or 'undecided', got 'fine'",
    ),
    "percentiles": (("methods", "bac", "latency_s", "p95"), 1e-9, "latency_s.p50: expected 0 < p50 <= p95"),
    "negative flops": (
        ("methods", "bac", "flops", "per_query"),
        -1.0,
        "methods.bac.flops.per_query: expected at least 0",
    ),
    "negative executed": (
        ("methods", "bac", "flops", "executed"),
        -1.0,
        "methods.bac.flops.executed: expected at least 0 or null",
    ),
    "no object": (("machine",), "fast", "machine: expected an object, got 'fast'"),
    "prune rate": (("methods", "bac", "prune_rate"), 90, "methods.bac.prune_rate: expected 0 to 1, got 90"),
    "tokens": (
        ("methods", "bac", "tokens"),
        {"kept_mean": 1.0, "kept_fine": "many", "kept_coarse": None},
        "methods.bac.tokens.kept_fine: expected a valid number, got 'many'",
    ),
    "split": (("split",), "train", "split: expected 'test' or 'development', got 'train'"),
    "horizon": (("episode_horizon",), 4.5, "episode_horizon: expected a valid integer, got 4.5"),
    "time ratio": (
        ("methods", "bac", "time_vs_dense", "ratio"),
        0,
        "methods.bac.time_vs_dense.ratio: expected a number above 0",
    ),
    "share": (
        ("methods", "bac", "success_within"),
        {"44": 1.2},
        "methods.bac.success_within: expected steps and",
    ),
    "p-value": (("methods", "bac", "p_values", "time"), 0.7, "methods.bac.p_values.time: expected 0 to 0.5"),
    "no times": (("methods", "bac", "time_vs_dense"), None, "methods.bac.time_vs_dense: expected an object"),
    "planning": (
        ("methods", "bac", "planning_s"),
        {"p50": 0.0, "p95": 1.0, "n": 3},
        "methods.bac.planning_s.p50: expected 0 < p50",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_path(name):
    path, value, message = FAULTS[name]
    results = to_plain(make_results(20))
    target = results
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(ValueError, match=message):
        read(results)


def test_missing_and_unknown_keys():
    results = to_plain(make_results(20))
    missing = copy.deepcopy(results)
    del missing["methods"]["bac"]["flops"]["ratio_to_dense"]
    with pytest.raises(ValueError, match=r"methods.bac.flops.ratio_to_dense: expected this key"):
        read(missing)
    unknown = copy.deepcopy(results)
    unknown["policy"]["params_m"] = 9
    with pytest.raises(ValueError, match=r"policy.params_m: expected no such key, got 9"):
        read(unknown)
    without = copy.deepcopy(results)
    del without["methods"]["dense"]
    with pytest.raises(ValueError, match="methods: expected the key 'dense'"):
        read(without)
    with pytest.raises(ValueError, match=r"results.json: expected an object, got \[1, 2\]"):
        read([1, 2])


def test_all_methods_have_as_many_episodes():
    results, fewer = make_results(20), make_results(10)
    with pytest.raises(ValueError, match=r"methods.bac.success.n: expected 20, as every method, got 10"):
        replace(results, methods={**results.methods, "bac": fewer.methods["bac"]})


def test_methods_may_stop_early_where_the_file_says_so():
    results, fewer = make_results(20), make_results(10)
    stopped = {**results.methods, "bac": fewer.methods["bac"]}
    early = replace(results, methods=stopped, until_decided=Stopping(20, 2))
    assert early.methods["bac"].success.n == 10
    more = {"dense": fewer.dense, "bac": results.methods["bac"]}
    with pytest.raises(ValueError, match=r"methods.bac.success.n: expected at most 10, as dense, got 20"):
        replace(early, methods=more)


def test_load_names_the_file(tmp_path):
    path = tmp_path / "results.json"
    path.write_text('{"schema": 2')
    with pytest.raises(ValueError, match=r"results.json: expected a complete JSON file"):
        load_results(path)
    for schema, why in (
        (9, "expected 2, got 9$"),
        (1, "expected 2, got 1; schema 1 had no times to success"),
    ):
        path.write_text(json.dumps({"schema": schema}))
        with pytest.raises(ValueError, match=rf"results.json: schema: {why}"):
            load_results(path)
