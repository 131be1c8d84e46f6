"""From what was measured to ``results.json`` (its schema is in `schema.py`), and from there to the table."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_sparse.evaluation.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.latency import Latency
from torchrl_sparse.evaluation.schema import REFERENCE, SCHEMA, outcome_entry, validate_results
from torchrl_sparse.evaluation.stats import (
    DEFAULT_MARGIN,
    PairedDifference,
    episodes_needed,
    paired_difference,
)
from torchrl_sparse.evaluation.tables import markdown_table
from torchrl_sparse.files import atomic_path

__all__ = ["MethodRun", "build_results", "format_table", "load_results", "save_results"]


@dataclass(frozen=True)
class MethodRun:
    """Everything measured of one method.

    Attributes:
        episodes: its episodes, the same seeds as every other method's, in any order.
        latency: of one query, measured interleaved with the other methods.
        action_error: (mean, maximum) absolute difference of its chunks to the dense policy's, on the same
            observations and the same noise; (0, 0) for the dense policy.
    """

    episodes: Sequence[EpisodeResult]
    latency: Latency
    action_error: tuple[float, float]


def build_results(
    runs: Mapping[str, MethodRun],
    *,
    task: str,
    seed: int,
    machine: Mapping[str, Any],
    policy: Mapping[str, int],
    margin: float = DEFAULT_MARGIN,
) -> dict[str, Any]:
    """Make the content of ``results.json`` from what was measured.

    Args:
        runs: method name -> its run; ``"dense"`` is the reference and must be there.
        task: name of the task.
        seed: of the whole benchmark.
        machine: see :func:`describe_machine`.
        policy: ``params, num_inference_steps, horizon, n_obs_steps, n_action_steps`` of the dense policy.
        margin: non-inferiority margin of the verdicts, a difference of success rates.

    Raises:
        ValueError: if the reference is missing, methods ran on different seeds, or a value is out of range.
    """
    if REFERENCE not in runs:
        raise ValueError(f"runs: expected the reference method {REFERENCE!r}, got {sorted(runs)}")
    results = {
        "schema": SCHEMA,
        "task": task,
        "seed": seed,
        "machine": dict(machine),
        "policy": dict(policy),
        "methods": {name: _method_entry(name, run, runs[REFERENCE], margin) for name, run in runs.items()},
    }
    validate_results(results)
    return results


def _method_entry(name: str, run: MethodRun, dense: MethodRun, margin: float) -> dict[str, Any]:
    ours, reference = _by_seed(run.episodes), _by_seed(dense.episodes)
    if ours.keys() != reference.keys():
        odd = sorted(ours.keys() ^ reference.keys())
        raise ValueError(
            f"{name}: expected the seeds of {REFERENCE!r}, got others: {odd[:10]} are in one only"
        )
    outcomes = [episode.success for episode in ours.values()]
    if name == REFERENCE:
        paired = PairedDifference(0.0, (0.0, 0.0), margin, "non-inferior", 0, 0, len(outcomes))
    else:
        paired = paired_difference(outcomes, [reference[seed].success for seed in ours], margin)
    cost, dense_cost = totals(run.episodes), totals(dense.episodes)
    return {
        **outcome_entry(outcomes, paired),
        "prune_rate": cost.prune_rate,
        "flops": {
            "per_query": cost.flops_per_query,
            "ratio_to_dense": cost.flops_per_query / dense_cost.flops_per_query,
        },
        "latency_s": run.latency.to_json(),
        "speedup_vs_dense": dense.latency.p50 / run.latency.p50,
        "action_error_vs_dense": {"mean": float(run.action_error[0]), "max": float(run.action_error[1])},
        "episode_length": cost.episode_length,
    }


def _by_seed(episodes: Sequence[EpisodeResult]) -> dict[int, EpisodeResult]:
    by_seed = {episode.seed: episode for episode in episodes}
    if len(by_seed) != len(episodes):
        raise ValueError(f"expected one episode per seed, got {len(episodes)} for {len(by_seed)} seeds")
    return by_seed


def save_results(results: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Validate ``results`` and write them atomically; returns the path."""
    validate_results(results)
    text = json.dumps(results, indent=1, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return Path(path)


def load_results(path: str | os.PathLike) -> dict[str, Any]:
    """Read and validate a ``results.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not JSON or not of this schema; the message names the file and the path inside
            it.
    """
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
        validate_results(results)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return results


def format_table(results: Mapping[str, Any]) -> str:
    """The table of a benchmark, as markdown that also lines up in a terminal, and the lines that explain it.

    Args:
        results: content of a ``results.json``.

    Raises:
        ValueError: if ``results`` is not of the schema.
    """
    validate_results(results)
    table = markdown_table(results_rows(results), left=("method", "verdict"))
    return f"{table}\n\n{results_note(results)}"


def results_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """The rows of the table, one per method: column -> text."""
    return [_table_row(name, method) for name, method in results["methods"].items()]


def _table_row(name: str, method: Mapping[str, Any]) -> dict[str, str]:
    success, paired, latency = method["success"], method["paired_vs_dense"], method["latency_s"]
    error, reference = method["action_error_vs_dense"], name == REFERENCE
    return {
        "method": name,
        "success": f"{success['k']}/{success['n']} {_percent_range(success['ci95'])}",
        "vs dense, points": "" if reference else f"{_points(paired['diff'])} {_point_range(paired['ci95'])}",
        "verdict": "reference" if reference else paired["verdict"],
        "pruned": f"{100 * method['prune_rate']:.1f} %",
        "GFLOPs/query": f"{method['flops']['per_query'] / 1e9:.2f}",
        "FLOPs ratio": f"{method['flops']['ratio_to_dense']:.3f}",
        "p50, ms": _milliseconds(latency["p50"]),
        "p95, ms": _milliseconds(latency["p95"]),
        "speed-up": f"{method['speedup_vs_dense']:.2f}×",
        "action error (max)": "" if reference else f"{error['mean']:.2g} ({error['max']:.2g})",
        "steps": f"{method['episode_length']:.1f}",
    }


def results_note(results: Mapping[str, Any]) -> str:
    """The lines that explain the table."""
    machine, policy = results["machine"], results["policy"]
    reference = results["methods"][REFERENCE]
    n, margin = reference["success"]["n"], reference["paired_vs_dense"]["margin"]
    threads = f"{machine['threads']} thread{'s' if machine['threads'] != 1 else ''}"
    lines = [
        f"{results['task']}, {n} paired episodes a method (seed {results['seed']}): the same initial states "
        "and the same noise for every method. Success with Wilson's 95 % interval, difference to dense with "
        "Tango's.",
        f"Verdict against a margin of {100 * margin:g} points: non-inferior if the whole interval lies above "
        f"-{100 * margin:g}, inferior if it lies below, else undecided (too few episodes to tell).",
        f"Dense: {policy['params']:,} parameters, {policy['num_inference_steps']} denoising steps. FLOPs are "
        "2·MAC of a query, denoiser only. Latency of a query, all methods interleaved in one process, on "
        f"{machine['cpu']}, {machine['device']}, {threads}, torch {machine['torch']}, "
        f"{machine['date'][:10]}.",
    ]
    if n < episodes_needed(margin):
        lines.append(
            f"{n} episodes cannot show non-inferiority at this margin even without one differing episode: "
            f"{episodes_needed(margin)} are needed."
        )
    return "\n".join(lines)


def _percent_range(interval: Sequence[float]) -> str:
    return f"[{100 * interval[0]:.0f}, {100 * interval[1]:.0f}] %"


def _points(difference: float) -> str:
    return f"{100 * difference:+.1f}"


def _point_range(interval: Sequence[float]) -> str:
    return f"[{_points(interval[0])}, {_points(interval[1])}]"


def _milliseconds(seconds: float) -> str:
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
