"""Figure of an acceleration: latency of every candidate against its error to the demonstrations."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import OTHER_COLORS
from torchrl_sparse.evaluation.figures.labels import place_labels
from torchrl_sparse.evaluation.figures.pareto import plain_log_ticks
from torchrl_sparse.evaluation.results.acceleration import FAMILIES, Acceleration
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.text import threads_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_acceleration"]

_DENSE_COLOR = "#333333"
_COLORS = dict(zip(FAMILIES, OTHER_COLORS, strict=False))
_NAMED = 4  # of the ranking, beside dense, what was played and the front


def plot_acceleration(acceleration: Acceleration, path: str | os.PathLike) -> Path:
    """Draw the error to demonstrations against the median latency of a policy call (log axes), coloured by family.

    Pale candidates are over the budget; a ring is around what was played, a star on what was chosen. The front, of which no
    candidate is beaten in both, is a line through candidates of all families, between which the error compares little.

    Args:
        acceleration: what was measured.
        path: of the PNG.
    """
    figure, axes = make_figure(9, 5.5)
    points = {
        name: (1e3 * candidate.latency_s.p50, candidate.error)
        for name, candidate in acceleration.candidates.items()
    }
    colors = {name: _color(acceleration, name) for name in points}
    for name, point in points.items():
        pale = name != DENSE and name not in acceleration.ranking
        marker, size = ("*", 15) if name == acceleration.chosen else ("s" if name == DENSE else "o", 8)
        axes.plot(*point, marker, color=colors[name], markersize=size, alpha=0.3 if pale else 1, zorder=3)
        if name in acceleration.played:
            axes.plot(*point, "o", mfc="none", mec=colors[name], markersize=17, zorder=2)
    front = _front(points)
    axes.plot(*zip(*(points[name] for name in front), strict=True), color="#B5B5BA", linewidth=1.2, zorder=1)
    _set_limits(axes, points)
    if acceleration.budget_ms is not None:
        axes.axvline(acceleration.budget_ms, color="#666666", linewidth=1, linestyle=(0, (4, 3)))
    axes.set_xlabel("latency per policy call, median (ms, log scale)")
    axes.set_ylabel("error of actions to demonstrations, normalised (log scale)")
    machine = acceleration.machine
    axes.set_title(f"{acceleration.task}; {machine.cpu}, {threads_text(machine.threads)}", loc="left")
    _family_legend(axes, acceleration)
    named = {DENSE, acceleration.chosen, *acceleration.played, *front, *acceleration.ranking[:_NAMED]}
    shown = {name: point for name, point in points.items() if name in named}
    place_labels(figure, axes, shown, {name: (y, y) for name, (_, y) in shown.items()}, colors, fontsize=9)
    return save_figure(figure, path)


def _color(acceleration: Acceleration, name: str) -> str:
    return _DENSE_COLOR if name == DENSE else _COLORS[acceleration.candidates[name].family]


def _front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the candidates that no other beats in both, the fastest first."""
    front: list[str] = []
    for name in sorted(points, key=points.__getitem__):
        if not front or points[name][1] < points[front[-1]][1]:
            front.append(name)
    return front


def _set_limits(axes: Axes, points: Mapping[str, tuple[float, float]]) -> None:
    """Leave room for labels, and write plain numbers at both axes."""
    latencies, errors = zip(*points.values(), strict=True)
    left, right, bottom, top = (
        *(min(latencies) / 1.6, max(latencies) * 1.6),
        *(min(errors) / 1.25, max(errors) * 1.25),
    )
    axes.set(xscale="log", yscale="log", xlim=(left, right), ylim=(bottom, top))
    axes.set_xticks(*plain_log_ticks(left, right))
    axes.set_yticks(*plain_log_ticks(bottom, top))
    axes.minorticks_off()


def _family_legend(axes: Axes, acceleration: Acceleration) -> None:
    from matplotlib.lines import Line2D

    present = {candidate.family for name, candidate in acceleration.candidates.items() if name != DENSE}
    handles = [
        Line2D([], [], color=_COLORS[family], marker="o", linestyle="", markersize=7, label=family)
        for family in FAMILIES
        if family in present
    ]
    if acceleration.played:
        ring = {"marker": "o", "linestyle": "", "markersize": 11, "mfc": "none"}
        handles.append(Line2D([], [], color="#777777", label="played", **ring))
    handles.append(Line2D([], [], color="#777777", marker="*", linestyle="", markersize=11, label="chosen"))
    axes.legend(handles=handles, loc="best", frameon=False, fontsize=9)
