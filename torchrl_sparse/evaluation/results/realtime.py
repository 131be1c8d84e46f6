"""``realtime.json`` and its table: success against simulated inference delay.

A latency acts by the number of steps that the world makes in it, so points are kept by that.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from torchrl_sparse.control.realtime_executor import delay_steps
from torchrl_sparse.envs.seeds import Split
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.build import Terms, compare_episodes
from torchrl_sparse.evaluation.results.comparisons import surviving
from torchrl_sparse.evaluation.results.parts import PValues, Success
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import (
    NO_VERDICT,
    count_text,
    difference_text,
    ratio_text,
    threads_text,
    verdict_text,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, totals
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference
from torchrl_sparse.storage.json import read_json

__all__ = [
    "Realtime",
    "RealtimeMethod",
    "RealtimePoint",
    "RealtimeRun",
    "build_realtime",
    "format_realtime",
    "load_realtime",
    "num_late_comparisons",
    "realtime_note",
    "realtime_rows",
]

SCHEMA = 2


@dataclass(frozen=True)
class RealtimePoint:
    """One method at one latency.

    Attributes:
        delay_steps: that the world makes in the latency.
        own: whether it is the method's own latency.
        success: of its episodes.
        paired_vs_dense: against the dense policy at its own latency where ``own``, else at the same latency.
        episode_length: mean, environment steps.
        restricted_mean_time: steps to success, mean; an episode that is not solved counts the horizon.
        time_vs_dense: its ratio to the dense policy's, compared like the success.
        p_values: of both verdicts; None of dense.
        correlation_with_dense: of its times with those that it is compared with; None also where either never differs.
    """

    delay_steps: int
    own: bool
    success: Success
    paired_vs_dense: Difference
    episode_length: float
    restricted_mean_time: float
    time_vs_dense: TimeDifference
    p_values: PValues | None = None
    correlation_with_dense: float | None = None


@dataclass(frozen=True)
class RealtimeMethod:
    """One method: its measured median latency, and its results by simulated latency."""

    own_latency_s: float
    points: tuple[RealtimePoint, ...]


@dataclass(frozen=True)
class Realtime:
    """The content of a ``realtime.json``, whose version is ``realtime``."""

    realtime: Literal[2]
    task: str
    seed: int
    control_freq: float
    n_action_steps: int
    machine: Machine
    methods: dict[str, RealtimeMethod]
    split: Split
    episode_horizon: int


@dataclass(frozen=True)
class RealtimeRun:
    """One method: its own latency in seconds, and its episodes, on the same seeds everywhere, by delay in steps."""

    own_latency: float
    episodes: Mapping[int, Sequence[EpisodeResult]]

    def own_delay(self, control_freq: float) -> int:
        """Count the environment steps that pass during a policy call."""
        return int(delay_steps(torch.tensor(self.own_latency), control_freq))


def build_realtime(
    runs: Mapping[str, RealtimeRun],
    *,
    task: str,
    split: Split,
    seed: int,
    control_freq: float,
    n_action_steps: int,
    machine: Machine,
    terms: Terms,
) -> Realtime:
    """Build the content of ``realtime.json``.

    Raises:
        InputError: if the dense policy is missing, methods differ in their delays (their own apart), or seeds differ.
    """
    if DENSE not in runs:
        raise InputError(f"runs: expected the method {DENSE!r} among them, got {sorted(runs)}")
    dense = runs[DENSE]
    dense_own = dense.episodes[dense.own_delay(control_freq)]
    methods = {}
    for name, run in runs.items():
        own, points = run.own_delay(control_freq), []
        for steps, episodes in sorted(run.episodes.items()):
            against = dense_own if steps == own and name != DENSE else dense.episodes.get(steps)
            if against is None:
                raise InputError(f"{name}: expected episodes of {DENSE!r} at {steps} steps of delay too")
            points.append(
                _point(name, steps, steps == own, compare_episodes(name, episodes, against, terms), episodes)
            )
        methods[name] = RealtimeMethod(run.own_latency, tuple(points))
    return Realtime(
        SCHEMA, task, seed, control_freq, n_action_steps, machine, methods, split, terms.episode_horizon
    )


def _point(
    name: str, steps: int, own: bool, compared: Mapping[str, Any], episodes: Sequence[EpisodeResult]
) -> RealtimePoint:
    return RealtimePoint(
        steps,
        own,
        Success.of([episode.success for episode in episodes]),
        compared["paired_vs_dense"],
        totals(episodes).episode_length,
        compared["restricted_mean_time"],
        compared["time_vs_dense"],
        compared.get("p_values"),
        compared["correlation_with_dense"],
    )


def load_realtime(path: str | os.PathLike) -> Realtime:
    """Read a ``realtime.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is not of this schema.
    """
    return read_json(path, Realtime)


def num_late_comparisons(results: Realtime) -> int:
    """Return the number of verdicts in the table: on success and time, for every point but dense's."""
    points = [point for name, method in results.methods.items() for point in method.points if name != DENSE]
    return 2 * len(points)


def realtime_rows(results: Realtime) -> list[dict[str, str]]:
    """Return one row of text per method and delay."""
    points = [(name, point) for name, method in results.methods.items() for point in method.points]
    p_values = {f"{name} +{point.delay_steps}": point.p_values for name, point in points}
    lasting = surviving(p_values, num_late_comparisons(results))
    return [_row(name, results, point, lasting) for name, point in points]


def _row(name: str, results: Realtime, point: RealtimePoint, lasting: Collection[str]) -> dict[str, str]:
    own = f"{1e3 * results.methods[name].own_latency_s:.3g} ms, its own" if point.own else ""
    tested, correlation = f"{name} +{point.delay_steps}", point.correlation_with_dense
    success, time = point.paired_vs_dense, point.time_vs_dense
    verdicts = [
        verdict_text(success, f"{tested} success" in lasting),
        verdict_text(time, f"{tested} time" in lasting),
    ]
    if not point.success.k and not success.diff:  # by either
        verdicts = [NO_VERDICT, NO_VERDICT]
    row = {
        "method": name,
        "delay, steps": str(point.delay_steps),
        "latency": own or f"{1e3 * point.delay_steps / results.control_freq:.0f} ms",
        "success": count_text(point.success),
        "vs dense, points": difference_text(success),
        "verdict": verdicts[0],
        "mean time, steps": f"{point.restricted_mean_time:.1f}",
        "time vs dense": ratio_text(time),
        "time verdict": verdicts[1],
        "correlation": "" if correlation is None else f"{correlation:.2f}",
    }
    if name != DENSE:
        return row
    compared = ("vs dense, points", "time vs dense", "time verdict", "correlation")
    return row | dict.fromkeys(compared, "") | {"verdict": "baseline"}


def format_realtime(results: Realtime) -> str:
    """Return the table, as Markdown that also lines up in a terminal, and its settings."""
    return f"{markdown_table(realtime_rows(results))}\n\n{realtime_note(results)}"


def realtime_note(results: Realtime) -> str:
    """Return the explanation of the table."""
    machine = results.machine
    every = f"a policy call every {results.n_action_steps} steps, or as soon as the last one is answered"
    return (
        f"{results.task}, {results.control_freq:g} Hz; {every}; the world goes on meanwhile. Success with Wilson's "
        "95 % interval, difference to dense with Tango's: at a method's own latency to dense at dense's own, else at the "
        f"same latency. Mean time to success, {results.episode_horizon} steps where there is none, is compared likewise. "
        f"{num_late_comparisons(results)} comparisons; † marks a verdict that does not survive Holm's correction for them. "
        f"Own latencies are medians on {machine.cpu}, {threads_text(machine.threads)}, "
        f"{machine.date[:10]}."
    )
