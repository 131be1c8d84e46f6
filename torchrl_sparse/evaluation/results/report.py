"""From what was measured to ``results.json`` (its schema is in `schema.py`), and from there to the table."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torchrl_sparse.evaluation.latency.measure import Latency
from torchrl_sparse.evaluation.results.schema import REFERENCE, SCHEMA, outcome_entry, validate_results
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, token_totals, totals
from torchrl_sparse.evaluation.statistics.intervals import (
    DEFAULT_MARGIN,
    PairedDifference,
    episodes_needed,
    paired_difference,
)
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["MethodRun", "build_results", "format_pairs", "format_table", "load_results", "save_results"]


@dataclass(frozen=True)
class MethodRun:
    """Everything measured of one method.

    Attributes:
        episodes: its episodes, the same seeds as every other method's, in any order.
        latency: of one query, measured interleaved with the other methods.
        action_error: (mean, maximum) absolute difference of its chunks to the dense policy's, on the same
            observations and the same noise; (0, 0) for the dense policy.
        planning: of the planner alone, within a query; where it looks at the observation.
    """

    episodes: Sequence[EpisodeResult]
    latency: Latency
    action_error: tuple[float, float]
    planning: Latency | None = None


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
    _check_seeds(name, ours, REFERENCE, reference)
    outcomes = [episode.success for episode in ours.values()]
    if name == REFERENCE:
        paired = PairedDifference(0.0, (0.0, 0.0), margin, "non-inferior", 0, 0, len(outcomes))
    else:
        paired = paired_difference(outcomes, [reference[seed].success for seed in ours], margin)
    cost, dense_cost = totals(run.episodes), totals(dense.episodes)
    entry = {
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
    if run.planning is not None:
        entry["planning_s"] = run.planning.to_json()
    if tokens := token_totals(run.episodes):
        entry["tokens"] = {f"kept_{name}": count for name, count in asdict(tokens).items()}
    return entry


def _check_seeds(name: str, ours: Mapping[int, Any], other: str, theirs: Mapping[int, Any]) -> None:
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise ValueError(f"{name}: expected the seeds of {other!r}, got others: {odd[:10]} are in one only")


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
    table = markdown_table(results_rows(results))
    return f"{table}\n\n{results_note(results)}"


def results_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """The rows of the table, one per method: column -> text."""
    return [_table_row(name, method) for name, method in results["methods"].items()]


def _table_row(name: str, method: Mapping[str, Any]) -> dict[str, str]:
    success, paired, latency = method["success"], method["paired_vs_dense"], method["latency_s"]
    error, reference = method["action_error_vs_dense"], name == REFERENCE
    tokens = {"tokens (coarse / fine)": _tokens(**method["tokens"])} if "tokens" in method else {}
    return {
        "method": name,
        "success": f"{success['k']}/{success['n']} {_percent_range(success['ci95'])}",
        "vs dense, points": "" if reference else f"{_points(paired['diff'])} {_point_range(paired['ci95'])}",
        "verdict": "reference" if reference else paired["verdict"],
        "pruned": f"{100 * method['prune_rate']:.1f} %",
        **tokens,
        "GFLOPs/query": f"{method['flops']['per_query'] / 1e9:.2f}",
        "FLOPs ratio": f"{method['flops']['ratio_to_dense']:.3f}",
        "p50, ms": _milliseconds(latency["p50"]),
        "p95, ms": _milliseconds(latency["p95"]),
        "speed-up": f"{method['speedup_vs_dense']:.2f}×",
        "action error (max)": "" if reference else f"{error['mean']:.2g} ({error['max']:.2g})",
        "steps": f"{method['episode_length']:.1f}",
    }


def format_pairs(
    episodes: Mapping[str, Sequence[EpisodeResult]],
    pairs: Sequence[Sequence[str]],
    margin: float = DEFAULT_MARGIN,
) -> str:
    """Return a table of differences in success between methods of which none need be dense, paired by seed.

    Args:
        episodes: method -> its episodes.
        pairs: of names, the first against the second; at least one pair.
        margin: non-inferiority margin of the verdict on the first.

    Raises:
        ValueError: if a pair is not two of the methods, or they ran on different seeds.

    >>> once = [EpisodeResult(0, True, 8, 1, 1.0, 0.0)]
    >>> print(format_pairs({"a": once, "b": once}, [("a", "b")]))
    | method   | against   |   success |   difference, points | verdict   |
    |:---------|:----------|----------:|---------------------:|:----------|
    | a        | b         |     1 : 1 |  +0.0 [-79.3, +79.3] | undecided |
    """
    return markdown_table(pair_rows(episodes, pairs, margin))


def pair_rows(
    episodes: Mapping[str, Sequence[EpisodeResult]], pairs: Sequence[Sequence[str]], margin: float
) -> list[dict[str, str]]:
    """Return the rows of `format_pairs`: column -> text."""
    return [_pair_row(episodes, pair, margin) for pair in pairs]


def _pair_row(
    episodes: Mapping[str, Sequence[EpisodeResult]], pair: Sequence[str], margin: float
) -> dict[str, str]:
    if len(pair) != 2 or not set(pair) <= set(episodes):
        raise ValueError(f"pairs: expected two of {', '.join(episodes)}, got {list(pair)}")
    first, second = (_by_seed(episodes[name]) for name in pair)
    _check_seeds(pair[0], first, pair[1], second)
    ours, theirs = [e.success for e in first.values()], [second[seed].success for seed in first]
    paired = paired_difference(ours, theirs, margin)
    return {
        "method": pair[0],
        "against": pair[1],
        "success": f"{sum(ours)} : {sum(theirs)}",
        "difference, points": f"{_points(paired.diff)} {_point_range(paired.ci)}",
        "verdict": paired.verdict,
    }


def results_note(results: Mapping[str, Any]) -> str:
    """The lines that explain the table."""
    machine, policy = results["machine"], results["policy"]
    reference = results["methods"][REFERENCE]
    n, margin = reference["success"]["n"], reference["paired_vs_dense"]["margin"]
    threads = f"{machine['threads']} thread{'s' if machine['threads'] != 1 else ''}"
    steps, flops = f"{policy['num_inference_steps']} denoising steps", "denoiser only"
    if "tokens" in reference:
        steps, flops = f"chunks of {policy['horizon']} actions", "whole network"
    lines = [
        f"{results['task']}, {n} paired episodes a method (seed {results['seed']}): the same initial states "
        "and the same noise for every method. Success with Wilson's 95 % interval, difference to dense with "
        "Tango's.",
        f"Verdict against a margin of {100 * margin:g} points: non-inferior if the whole interval lies above "
        f"-{100 * margin:g}, inferior if it lies below, else undecided (too few episodes to tell).",
        f"Dense: {policy['params']:,} parameters, {steps}. FLOPs are "
        f"2·MAC of a query, {flops}. Latency of a query, all methods interleaved in one process, on "
        f"{machine['cpu']}, {machine['device']}, {threads}, torch {machine['torch']}, "
        f"{machine['date'][:10]}.",
    ]
    if planning := ", ".join(_planning(results["methods"])):
        lines.append(f"Planning takes, of that and measured within queries, {planning}.")
    if n < episodes_needed(margin):
        lines.append(
            f"{n} episodes cannot show non-inferiority at this margin even without one differing episode: "
            f"{episodes_needed(margin)} are needed."
        )
    return "\n".join(lines)


def _planning(methods: Mapping[str, Any]) -> Iterator[str]:
    """What each planner that looks at the observation takes, and its share of a query."""
    for name, method in methods.items():
        if "planning_s" in method:
            seconds = method["planning_s"]["p50"]
            share = 100 * seconds / method["latency_s"]["p50"]
            yield f"{_milliseconds(seconds)} ms ({share:.1f} %) under {name}"


def format_percent(k: int, n: int, rate: float, ci95: Sequence[float]) -> str:
    """Return a success rate with its interval, in percent.

    >>> format_percent(399, 400, 0.9975, (0.986, 0.9996))
    '99.8 [99, 100]'
    """
    return f"{100 * rate:.1f} {_percent_range(ci95).removesuffix(' %')}"


def _percent_range(interval: Sequence[float]) -> str:
    return f"[{100 * interval[0]:.0f}, {100 * interval[1]:.0f}] %"


def _tokens(kept_mean: float, kept_fine: float | None, kept_coarse: float | None) -> str:
    modes = [f"{count:.0f}" if count is not None else "-" for count in (kept_coarse, kept_fine)]
    return f"{kept_mean:.1f} ({' / '.join(modes)})"


def _points(difference: float) -> str:
    return f"{100 * difference:+.1f}"


def _point_range(interval: Sequence[float]) -> str:
    return f"[{_points(interval[0])}, {_points(interval[1])}]"


def _milliseconds(seconds: float) -> str:
    value = 1e3 * seconds
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
