"""Success against latency in a world that does not wait: ``realtime.json`` and its table.

A latency acts by the number of steps that the world makes in it, so points are kept by that.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from torchrl_sparse.control.realtime_executor import delay_steps
from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.parts import Difference, Success
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import count_text, difference_text, threads_text
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.statistics.intervals import paired_difference
from torchrl_sparse.storage.json import read_json, write_json

__all__ = [
    "Realtime",
    "RealtimeMethod",
    "RealtimePoint",
    "RealtimeRun",
    "build_realtime",
    "format_realtime",
    "load_realtime",
    "realtime_note",
    "realtime_rows",
    "save_realtime",
]

SCHEMA = 1


@dataclass(frozen=True)
class RealtimePoint:
    """A method under one latency.

    Attributes:
        delay_steps: that the world makes in the latency.
        own: whether it is the method's own latency.
        success: of its episodes.
        paired_vs_dense: against the dense policy at its own latency where ``own``, else at the same latency.
        episode_length: mean, environment steps.
    """

    delay_steps: int
    own: bool
    success: Success
    paired_vs_dense: Difference
    episode_length: float


@dataclass(frozen=True)
class RealtimeMethod:
    """A method: the median of its own latency, measured, and its points by latency."""

    own_latency_s: float
    points: tuple[RealtimePoint, ...]


@dataclass(frozen=True)
class Realtime:
    """The content of a ``realtime.json``, whose version is ``realtime``."""

    realtime: Literal[1]
    task: str
    seed: int
    control_freq: float
    n_action_steps: int
    machine: Machine
    methods: dict[str, RealtimeMethod]


@dataclass(frozen=True)
class RealtimeRun:
    """One method: its own latency in seconds, and its episodes, the same seeds everywhere, by steps of delay."""

    own_latency: float
    episodes: Mapping[int, Sequence[EpisodeResult]]

    def own_delay(self, control_freq: float) -> int:
        """Count the steps that the world makes in a query."""
        return int(delay_steps(torch.tensor(self.own_latency), control_freq))


def build_realtime(
    runs: Mapping[str, RealtimeRun],
    *,
    task: str,
    seed: int,
    control_freq: float,
    n_action_steps: int,
    machine: Machine,
    margin: float,
) -> Realtime:
    """Make the content of ``realtime.json``.

    Raises:
        ValueError: if the dense policy is missing, methods differ in their delays (their own apart), or seeds differ.
    """
    if DENSE not in runs:
        raise ValueError(f"runs: expected the method {DENSE!r} among them, got {sorted(runs)}")
    dense = runs[DENSE]
    dense_own = dense.episodes[dense.own_delay(control_freq)]
    methods = {}
    for name, run in runs.items():
        own, points = run.own_delay(control_freq), []
        for steps, episodes in sorted(run.episodes.items()):
            against = dense_own if steps == own else dense.episodes.get(steps)
            if against is None:
                raise ValueError(f"{name}: expected episodes of {DENSE!r} at {steps} steps of delay too")
            success, difference = _compare(name, episodes, against, margin)
            length = totals(episodes).episode_length
            points.append(RealtimePoint(steps, steps == own, success, difference, length))
        methods[name] = RealtimeMethod(run.own_latency, tuple(points))
    return Realtime(SCHEMA, task, seed, control_freq, n_action_steps, machine, methods)


def _compare(
    name: str, episodes: Sequence[EpisodeResult], dense: Sequence[EpisodeResult], margin: float
) -> tuple[Success, Difference]:
    if [episode.seed for episode in episodes] != [episode.seed for episode in dense]:
        raise ValueError(f"{name}: expected the seeds of {DENSE!r}, in their order, got others")
    outcomes = [episode.success for episode in episodes]
    paired = paired_difference(outcomes, [episode.success for episode in dense], margin)
    return Success.of(outcomes), Difference.of(paired)


def save_realtime(results: Realtime, path: str | os.PathLike) -> Path:
    """Write a ``realtime.json`` in one piece or not at all; return the path."""
    return write_json(path, results)


def load_realtime(path: str | os.PathLike) -> Realtime:
    """Read a ``realtime.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file and key, if it is not of this schema.
    """
    return read_json(path, Realtime)


def realtime_rows(results: Realtime) -> list[dict[str, str]]:
    """Return one row of text per method and delay."""
    return [
        _row(name, method, point, results.control_freq)
        for name, method in results.methods.items()
        for point in method.points
    ]


def _row(name: str, method: RealtimeMethod, point: RealtimePoint, control_freq: float) -> dict[str, str]:
    own = f"{1e3 * method.own_latency_s:.3g} ms, its own" if point.own else ""
    return {
        "method": name,
        "delay, steps": str(point.delay_steps),
        "latency": own or f"{1e3 * point.delay_steps / control_freq:.0f} ms",
        "success": count_text(point.success),
        "vs dense, points": "" if name == DENSE else difference_text(point.paired_vs_dense),
        "steps": f"{point.episode_length:.1f}",
    }


def format_realtime(results: Realtime) -> str:
    """Return the table, as Markdown that also lines up in a terminal, and what it was made with."""
    return f"{markdown_table(realtime_rows(results))}\n\n{realtime_note(results)}"


def realtime_note(results: Realtime) -> str:
    """Return the lines that explain the table."""
    machine = results.machine
    every = f"a query every {results.n_action_steps} steps, or as soon as the last one is answered"
    return (
        f"{results.task}, {results.control_freq:g} Hz; {every}; the world goes on meanwhile. Success with Wilson's "
        "95 % interval, difference to dense with Tango's: at a method's own latency to dense at dense's own, else at the "
        f"same latency. Own latencies are medians on {machine.cpu}, {threads_text(machine.threads)}, {machine.date[:10]}."
    )
