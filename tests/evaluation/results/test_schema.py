"""What a `results.json` may hold, and in which words everything else is refused."""

import copy
import json
import math
import os
from dataclasses import replace

import pytest

from tests.evaluation.synthetic import make_results
from tests.refusals import refused
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
    with refused("results.json: seed"):
        save_results(replace(make_results(20), seed="zero"), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["results.json"]


FAULTS = {
    "schema": (("schema",), 1, "results.json: schema"),
    "boolean integer": (("seed",), True, "results.json: seed"),
    "float integer": (("machine", "threads"), 1.0, "results.json: machine.threads"),
    "number for text": (("task",), 7, "results.json: task"),
    "nan": (("methods", "bac", "prune_rate"), math.nan, "results.json"),
    "rate": (("methods", "bac", "success", "rate"), 0.5, "results.json: methods.bac.success.rate"),
    "k beyond n": (("methods", "bac", "success", "k"), 21, "results.json: methods.bac.success.k"),
    "no episodes": (("methods", "bac", "success", "n"), 0, "results.json: methods.bac.success.n"),
    "reversed interval": (
        ("methods", "bac", "success", "ci95"),
        [0.9, 0.1],
        "results.json: methods.bac.success.ci95",
    ),
    "short interval": (
        ("methods", "bac", "paired_vs_dense", "ci95"),
        [0.9],
        "results.json: methods.bac.paired_vs_dense.ci95.1",
    ),
    "verdict": (
        ("methods", "bac", "paired_vs_dense", "verdict"),
        "fine",
        "methods.bac.paired_vs_dense.verdict",
    ),
    "percentiles": (("methods", "bac", "latency_s", "p95"), 1e-9, "results.json: methods.bac.latency_s.p50"),
    "negative flops": (
        ("methods", "bac", "flops", "per_query"),
        -1.0,
        "results.json: methods.bac.flops.per_query",
    ),
    "negative executed": (
        ("methods", "bac", "flops", "executed"),
        -1.0,
        "results.json: methods.bac.flops.executed",
    ),
    "no object": (("machine",), "fast", "results.json: machine"),
    "prune rate": (("methods", "bac", "prune_rate"), 90, "results.json: methods.bac.prune_rate"),
    "tokens": (
        ("methods", "bac", "tokens"),
        {"kept_mean": 1.0, "kept_fine": "many", "kept_coarse": None},
        "results.json: methods.bac.tokens.kept_fine",
    ),
    "split": (("split",), "train", "results.json: split"),
    "horizon": (("episode_horizon",), 4.5, "results.json: episode_horizon"),
    "time ratio": (
        ("methods", "bac", "time_vs_dense", "ratio"),
        0,
        "results.json: methods.bac.time_vs_dense.ratio",
    ),
    "share": (
        ("methods", "bac", "success_within"),
        {"44": 1.2},
        "results.json: methods.bac.success_within",
    ),
    "p-value": (("methods", "bac", "p_values", "time"), 0.7, "results.json: methods.bac.p_values.time"),
    "no times": (("methods", "bac", "time_vs_dense"), None, "results.json: methods.bac.time_vs_dense"),
    "planning": (
        ("methods", "bac", "planning_s"),
        {"p50": 0.0, "p95": 1.0, "n": 3},
        "results.json: methods.bac.planning_s.p50",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_with_its_path(name):
    path, value, entry = FAULTS[name]
    results = to_plain(make_results(20))
    target = results
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with refused(entry):
        read(results)


def test_missing_and_unknown_keys():
    results = to_plain(make_results(20))
    missing = copy.deepcopy(results)
    del missing["methods"]["bac"]["flops"]["ratio_to_dense"]
    with refused("results.json: methods.bac.flops.ratio_to_dense"):
        read(missing)
    unknown = copy.deepcopy(results)
    unknown["policy"]["params_m"] = 9
    with refused("results.json: policy.params_m"):
        read(unknown)
    without = copy.deepcopy(results)
    del without["methods"]["dense"]
    with refused("results.json: methods"):
        read(without)
    with refused("results.json"):
        read([1, 2])


def test_all_methods_have_as_many_episodes():
    results, fewer = make_results(20), make_results(10)
    with refused("methods.bac.success.n"):
        replace(results, methods={**results.methods, "bac": fewer.methods["bac"]})


def test_methods_may_stop_early_where_the_file_says_so():
    results, fewer = make_results(20), make_results(10)
    stopped = {**results.methods, "bac": fewer.methods["bac"]}
    early = replace(results, methods=stopped, until_conclusive=Stopping(20, 2))
    assert early.methods["bac"].success.n == 10
    more = {"dense": fewer.dense, "bac": results.methods["bac"]}
    with refused("methods.bac.success.n"):
        replace(early, methods=more)


def test_load_names_the_file(tmp_path):
    path = tmp_path / "results.json"
    path.write_text('{"schema": 2')
    with refused("results.json"):
        load_results(path)
    for schema in (9, 1):
        path.write_text(json.dumps({"schema": schema}))
        with refused("results.json: schema"):
            load_results(path)
