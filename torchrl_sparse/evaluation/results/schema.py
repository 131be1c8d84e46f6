"""``results.json``: the only source of every table and figure.

Schema version 1 (all numbers finite; no other keys)::

    {"schema": 1, "task": str, "seed": int,
     "machine": {"cpu": str, "threads": int, "device": str, "torch": str, "date": str},
     "policy": {"params": int, "num_inference_steps": int, "horizon": int, "n_obs_steps": int,
                "n_action_steps": int},
     "methods": {NAME: {
        "success": {"k": int, "n": int, "rate": float, "ci95": [lo, hi]},
        "paired_vs_dense": {"diff": float, "ci95": [lo, hi], "margin": float, "verdict": str},
        "prune_rate": float,
        "flops": {"per_query": float, "ratio_to_dense": float},
        "latency_s": {"p50": float, "p95": float, "n": int},
        "speedup_vs_dense": float,
        "action_error_vs_dense": {"mean": float, "max": float},
        "episode_length": float,
        "planning_s": {"p50": float, "p95": float, "n": int},
        "tokens": {"kept_mean": float, "kept_fine": float | null, "kept_coarse": float | null}}}}

``success.ci95`` is Wilson's interval; ``paired_vs_dense`` compares success on the same seeds, with Tango's
interval and a verdict ``"non-inferior"``, ``"inferior"`` or ``"undecided"`` against ``margin``;
``prune_rate`` is the pruned share of the blocks, or of the visual tokens; ``flops`` are 2 * MAC of one
query, denoiser only, or of a whole vision-language-action model; ``latency_s`` is
in seconds per query and ``speedup_vs_dense`` the ratio of the medians; ``action_error_vs_dense`` is the
absolute difference of an action entry, on the same observations and the same noise; ``episode_length`` is a
mean in environment steps. ``planning_s``, the part of a query in which the planner decides, is there where it looks at the
observation; ``tokens`` is there for policies with visual tokens alone: how many are in a decoder layer, mean over
layers and queries, and over the queries in fine and in coarse mode, null without any.

``methods`` always holds ``"dense"``. Its own ``paired_vs_dense`` is ``diff 0, ci95 [0, 0], "non-
inferior"``: a policy equals itself by definition, nothing is estimated.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from torchrl_sparse.evaluation.statistics.intervals import PairedDifference, Verdict, wilson_interval

__all__ = ["MACHINE", "OUTCOME", "REFERENCE", "SCHEMA", "check_types", "outcome_entry", "validate_results"]

SCHEMA = 1
REFERENCE = "dense"

MACHINE = {"cpu": str, "threads": int, "device": str, "torch": str, "date": str}
OUTCOME = {
    "success": {"k": int, "n": int, "rate": float, "ci95": "interval"},
    "paired_vs_dense": {"diff": float, "ci95": "interval", "margin": float, "verdict": str},
}
_METHOD = {
    **OUTCOME,
    "prune_rate": float,
    "flops": {"per_query": float, "ratio_to_dense": float},
    "latency_s": {"p50": float, "p95": float, "n": int},
    "speedup_vs_dense": float,
    "action_error_vs_dense": {"mean": float, "max": float},
    "episode_length": float,
}
# Of some methods only.
_PARTS = {
    "planning_s": {"p50": float, "p95": float, "n": int},
    "tokens": {"kept_mean": float, "kept_fine": "number or null", "kept_coarse": "number or null"},
}
_RESULTS = {
    "schema": int,
    "task": str,
    "seed": int,
    "machine": MACHINE,
    "policy": {
        "params": int,
        "num_inference_steps": int,
        "horizon": int,
        "n_obs_steps": int,
        "n_action_steps": int,
    },
    "methods": dict,
}


def outcome_entry(outcomes: Sequence[bool], paired: PairedDifference) -> dict[str, Any]:
    """What `OUTCOME` describes: success of the episodes, and their difference to dense.

    >>> from torchrl_sparse.evaluation.statistics.intervals import paired_difference
    >>> outcome_entry([True, False], paired_difference([True, False], [True, True], 0.05))["success"]["rate"]
    0.5
    """
    k, n = sum(outcomes), len(outcomes)
    return {
        "success": {"k": k, "n": n, "rate": k / n, "ci95": list(wilson_interval(k, n))},
        "paired_vs_dense": {
            "diff": paired.diff,
            "ci95": list(paired.ci),
            "margin": paired.margin,
            "verdict": paired.verdict,
        },
    }


def validate_results(results: Any) -> None:
    """Check that ``results`` is of schema version 1 and agrees with itself.

    Raises:
        ValueError: naming the path inside ``results``, what was expected there and what came.

    >>> validate_results({"schema": 2})
    Traceback (most recent call last):
    ...
    ValueError: schema: expected 1, got 2
    """
    if isinstance(results, Mapping) and results.get("schema", SCHEMA) != SCHEMA:
        raise _fault("schema", SCHEMA, results["schema"])
    check_types(results, _RESULTS, "")
    if REFERENCE not in results["methods"]:
        raise _fault("methods", f"the key {REFERENCE!r}", sorted(results["methods"]))
    n = None
    for name, method in results["methods"].items():
        path = f"methods.{name}"
        there = {key: spec for key, spec in _PARTS.items() if isinstance(method, Mapping) and key in method}
        check_types(method, _METHOD | there, path)
        _check_method_values(method, path)
        n = method["success"]["n"] if n is None else n
        _require(
            method["success"]["n"] == n, f"{path}.success.n", f"{n}, as every method", method["success"]["n"]
        )


def _check_method_values(method: Mapping[str, Any], path: str) -> None:
    success, paired, latency = method["success"], method["paired_vs_dense"], method["latency_s"]
    k, n, rate = success["k"], success["n"], success["rate"]
    _require(n >= 1, f"{path}.success.n", "at least 1", n)
    _require(0 <= k <= n, f"{path}.success.k", f"0 to {n}", k)
    _require(math.isclose(rate, k / n, abs_tol=1e-9), f"{path}.success.rate", f"k / n = {k / n}", rate)
    _require(
        all(0 <= limit <= 1 for limit in success["ci95"]),
        f"{path}.success.ci95",
        "within [0, 1]",
        success["ci95"],
    )
    _require(-1 <= paired["diff"] <= 1, f"{path}.paired_vs_dense.diff", "-1 to 1", paired["diff"])
    _require(0 < paired["margin"] < 1, f"{path}.paired_vs_dense.margin", "between 0 and 1", paired["margin"])
    verdicts = get_args(Verdict)
    _require(
        paired["verdict"] in verdicts,
        f"{path}.paired_vs_dense.verdict",
        f"one of {verdicts}",
        paired["verdict"],
    )
    _require(0 <= method["prune_rate"] <= 1, f"{path}.prune_rate", "0 to 1", method["prune_rate"])
    _check_latency(latency, f"{path}.latency_s")
    if "planning_s" in method:
        _check_latency(method["planning_s"], f"{path}.planning_s")
    for key in ("flops", "action_error_vs_dense"):
        _require(min(method[key].values()) >= 0, f"{path}.{key}", "values >= 0", method[key])


def _check_latency(latency: Mapping[str, Any], path: str) -> None:
    _require(0 < latency["p50"] <= latency["p95"], path, "0 < p50 <= p95", latency)
    _require(latency["n"] >= 1, f"{path}.n", "at least 1", latency["n"])


def check_types(value: Any, spec: Any, path: str) -> None:
    """Check a value against a nested specification: a type, ``"interval"``, ``"number or null"``, or a mapping of the only keys
    to theirs.

    Raises:
        ValueError: naming the path, which is ``path`` and the keys below it.

    >>> check_types({"k": 1.5}, {"k": int}, "success")
    Traceback (most recent call last):
    ...
    ValueError: success.k: expected an integer, got 1.5
    """
    if isinstance(spec, Mapping):
        _require(isinstance(value, Mapping), path or "results", "an object", value)
        for key in spec:
            _require(key in value, f"{path}.{key}".lstrip("."), "this key", "nothing")
        unknown = sorted(str(key) for key in value if key not in spec)
        _require(not unknown, path or "results", f"only the keys {sorted(spec)}", f"also {unknown}")
        for key, inner in spec.items():
            check_types(value[key], inner, f"{path}.{key}".lstrip("."))
    elif spec == "interval":
        pair = isinstance(value, Sequence) and len(value) == 2 and all(_is_number(limit) for limit in value)
        _require(pair and value[0] <= value[1], path, "[low, high] with low <= high", value)
    elif spec == "number or null":
        _require(value is None or _is_number(value), path, "a finite number or null", value)
    elif spec is float:
        _require(_is_number(value), path, "a finite number", value)
    elif spec is int:
        _require(isinstance(value, int) and not isinstance(value, bool), path, "an integer", value)
    else:
        names = {str: "a string", dict: "an object", list: "an array", bool: "true or false"}
        _require(isinstance(value, spec), path, names[spec], value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _require(condition: bool, path: str, expected: Any, got: Any) -> None:
    if not condition:
        raise _fault(path, expected, got)


def _fault(path: str, expected: Any, got: Any) -> ValueError:
    return ValueError(f"{path}: expected {expected}, got {got!r}")
