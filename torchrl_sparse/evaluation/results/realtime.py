"""Success against latency in a world that does not wait: ``realtime.json``, its table and its figure.

Schema version 1::

    {"realtime": 1, "task": str, "seed": int, "control_freq": float, "n_action_steps": int, "machine": {...},
     "methods": {NAME: {
        "own_latency_s": float,              # median of a query, measured
        "points": [{"delay_steps": int, "own": bool,
                    "success": {"k": int, "n": int, "rate": float, "ci95": [lo, hi]},
                    "paired_vs_dense": {"diff": float, "ci95": [lo, hi], "margin": float, "verdict": str},
                    "episode_length": float}, ...]}}}

A latency acts by the number of steps that the world makes in it, so points are kept by that. ``own`` marks the point
of the method's own latency; its ``paired_vs_dense`` compares with the dense policy at the dense policy's own latency,
that of every other point with the dense policy at the same latency.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.control.realtime_executor import delay_steps
from torchrl_sparse.evaluation.figures.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.plots import method_colors
from torchrl_sparse.evaluation.results.schema import MACHINE, OUTCOME, REFERENCE, check_types, outcome_entry
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.statistics.intervals import paired_difference
from torchrl_sparse.storage.atomic import atomic_path

__all__ = [
    "RealtimeRun",
    "build_realtime",
    "format_realtime",
    "load_realtime",
    "plot_realtime",
    "save_realtime",
]

SCHEMA = 1
_RESULTS = {
    "realtime": int,
    "task": str,
    "seed": int,
    "control_freq": float,
    "n_action_steps": int,
    "machine": MACHINE,
    "methods": dict,
}
_POINT = {"delay_steps": int, "own": bool, **OUTCOME, "episode_length": float}


@dataclass(frozen=True)
class RealtimeRun:
    """One method: its own latency in seconds, and its episodes, the same seeds everywhere, by steps of delay."""

    own_latency: float
    episodes: Mapping[int, Sequence[EpisodeResult]]

    def own_delay(self, control_freq: float) -> int:
        """Steps that the world makes in a query."""
        return int(delay_steps(torch.tensor(self.own_latency), control_freq))


def build_realtime(
    runs: Mapping[str, RealtimeRun],
    *,
    task: str,
    seed: int,
    control_freq: float,
    n_action_steps: int,
    machine: Mapping[str, Any],
    margin: float,
) -> dict[str, Any]:
    """Make the content of ``realtime.json``.

    Raises:
        ValueError: if the dense policy is missing, methods differ in their delays (their own apart), or seeds differ.
    """
    if REFERENCE not in runs:
        raise ValueError(f"runs: expected the reference method {REFERENCE!r}, got {sorted(runs)}")
    dense = runs[REFERENCE]
    dense_own = dense.episodes[dense.own_delay(control_freq)]
    methods = {}
    for name, run in runs.items():
        own, points = run.own_delay(control_freq), []
        for steps, episodes in sorted(run.episodes.items()):
            reference = dense_own if steps == own else dense.episodes.get(steps)
            if reference is None:
                raise ValueError(f"{name}: expected episodes of {REFERENCE!r} at {steps} steps of delay too")
            points.append(
                {"delay_steps": steps, "own": steps == own, **_point(name, episodes, reference, margin)}
            )
        methods[name] = {"own_latency_s": run.own_latency, "points": points}
    return {
        "realtime": SCHEMA,
        "task": task,
        "seed": seed,
        "control_freq": control_freq,
        "n_action_steps": n_action_steps,
        "machine": dict(machine),
        "methods": methods,
    }


def _point(
    name: str, episodes: Sequence[EpisodeResult], reference: Sequence[EpisodeResult], margin: float
) -> dict[str, Any]:
    if [episode.seed for episode in episodes] != [episode.seed for episode in reference]:
        raise ValueError(f"{name}: expected the seeds of {REFERENCE!r}, in their order, got others")
    outcomes = [episode.success for episode in episodes]
    paired = paired_difference(outcomes, [episode.success for episode in reference], margin)
    return {**outcome_entry(outcomes, paired), "episode_length": totals(episodes).episode_length}


def save_realtime(results: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Write ``realtime.json`` atomically; returns the path."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(results, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return Path(path)


def load_realtime(path: str | os.PathLike) -> dict[str, Any]:
    """Read a ``realtime.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not JSON or not of this schema.
    """
    try:
        results = json.loads(Path(path).read_text(encoding="utf-8"))
        _check_realtime(results)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return results


def _check_realtime(results: Any) -> None:
    found = results.get("realtime") if isinstance(results, dict) else None
    if found != SCHEMA:
        raise ValueError(f"expected realtime results of schema {SCHEMA}, got {found!r}")
    check_types(results, _RESULTS, "")
    for name, method in results["methods"].items():
        check_types(method, {"own_latency_s": float, "points": list}, f"methods.{name}")
        for index, point in enumerate(method["points"]):
            check_types(point, _POINT, f"methods.{name}.points.{index}")


def realtime_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """One row of text per method and delay, for a table."""
    rows = []
    for name, method in results["methods"].items():
        for point in method["points"]:
            success, paired = point["success"], point["paired_vs_dense"]
            low, high = (100 * limit for limit in success["ci95"])
            steps = point["delay_steps"]
            own = f"{1e3 * method['own_latency_s']:.3g} ms, its own" if point["own"] else ""
            versus = f"{100 * paired['diff']:+.1f} [{100 * paired['ci95'][0]:+.1f}, {100 * paired['ci95'][1]:+.1f}]"
            rows.append(
                {
                    "method": name,
                    "delay, steps": str(steps),
                    "latency": own or f"{1e3 * steps / results['control_freq']:.0f} ms",
                    "success": f"{success['k']}/{success['n']} [{low:.0f}, {high:.0f}] %",
                    "vs dense, points": "" if name == REFERENCE else versus,
                    "steps": f"{point['episode_length']:.1f}",
                }
            )
    return rows


def format_realtime(results: Mapping[str, Any]) -> str:
    """The table as markdown that also lines up in a terminal, and what it says."""
    table = markdown_table(realtime_rows(results))
    return f"{table}\n\n{realtime_note(results)}"


def realtime_note(results: Mapping[str, Any]) -> str:
    """What the table was made with."""
    machine = results["machine"]
    every = f"a query every {results['n_action_steps']} steps, or as soon as the last one is answered"
    threads = f"{machine['threads']} thread{'' if machine['threads'] == 1 else 's'}"
    return (
        f"{results['task']}, {results['control_freq']:g} Hz; {every}; the world goes on meanwhile. Success with Wilson's "
        "95 % interval, difference to dense with Tango's: at a method's own latency to dense at dense's own, else at the "
        f"same latency. Own latencies are medians on {machine['cpu']}, {threads}, {machine['date'][:10]}."
    )


def plot_realtime(results: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Success, with its interval, against latency; a star where each method's own latency puts it."""
    figure, axes = make_figure(9, 5)
    colors, period = method_colors(results["methods"]), 1e3 / results["control_freq"]
    for index, (name, method) in enumerate(results["methods"].items()):
        # Beside each other, so that the intervals of methods with equal success stay apart.
        shift = (index - (len(results["methods"]) - 1) / 2) * 0.06 * period
        x = [period * point["delay_steps"] + shift for point in method["points"]]
        y = [100 * point["success"]["rate"] for point in method["points"]]
        axes.plot(x, y, "o-", color=colors[name], linewidth=1.8, markersize=5, label=name)
        for at, height, point in zip(x, y, method["points"], strict=True):
            interval = [100 * limit for limit in point["success"]["ci95"]]
            axes.vlines(at, *interval, color=colors[name], linewidth=2, alpha=0.45)
            if point["own"]:
                axes.plot(at, height, "*", color=colors[name], markersize=17, zorder=3)
    axes.set_ylim(-2, 103)
    axes.set_xlabel("latency, as the steps that the world makes in it (ms)")
    axes.set_ylabel("success (%), 95 % interval")
    n = results["methods"][REFERENCE]["points"][0]["success"]["n"]
    axes.set_title(f"{results['task']}: {n} paired episodes; a star is a method's own latency", loc="left")
    axes.legend(loc="lower left", frameon=False)
    return save_figure(figure, path)
