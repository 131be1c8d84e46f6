"""Figure of success against latency."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.evaluation.figures.labels import place_labels
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry, Results
from torchrl_sparse.evaluation.results.text import threads_text
from torchrl_sparse.evaluation.statistics.differences import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plain_log_ticks", "plot_pareto"]

_FRONT_COLOR = "#B5B5BA"
_MARKERS = {"non-inferior": "o", "inconclusive": "D", "inferior": "X"}


def plot_pareto(results: Results, path: str | os.PathLike) -> Path:
    """Draw success, or the score, with its interval, against the median latency of a policy call (log axis).

    The marker is the verdict.

    Args:
        results: of a benchmark.
        path: of the PNG.
    """
    methods = results.methods
    figure, axes = make_figure(9, 5)
    heights = {name: _height(method) for name, method in methods.items()}
    points = {name: (1e3 * method.latency_s.p50, 100 * heights[name][0]) for name, method in methods.items()}
    intervals = {name: [100 * limit for limit in ci95] for name, (_, ci95) in heights.items()}
    colors = method_colors(methods)
    axes.set_xscale("log")
    for name, method in methods.items():
        axes.vlines(points[name][0], *intervals[name], color=colors[name], linewidth=2, alpha=0.55)
        marker = "s" if name == DENSE else _MARKERS[method.judged.verdict]
        axes.plot(*points[name], marker, color=colors[name], markersize=9, zorder=3)
    _draw_front(axes, points)
    _set_limits(axes, points, min(low for low, _ in intervals.values()))
    _draw_margin(axes, points[DENSE][1], 100 * results.dense.paired_vs_dense.margin, colors[DENSE])
    axes.set_xlabel("latency per policy call, median (ms, log scale)")
    what = "score, % of the highest" if results.graded else "success (%)"
    axes.set_ylabel(f"{what}, 95 % interval")
    title = f"{results.task}: {results.dense.success.n} paired episodes; {results.machine.cpu}"
    axes.set_title(f"{title}, {threads_text(results.machine.threads)}", loc="left")
    _verdict_legend(figure, axes, methods)
    place_labels(figure, axes, points, intervals, colors)
    return save_figure(figure, path)


def _height(method: MethodEntry) -> tuple[float, Interval]:
    """Return what is drawn of a method, and its interval."""
    if method.score:
        return method.score.mean, method.score.ci95
    return method.success.rate, method.success.ci95


def _set_limits(axes: Axes, points: Mapping[str, tuple[float, float]], lowest: float) -> None:
    """Leave room for labels around all points and intervals."""
    latencies = [latency for latency, _ in points.values()]
    low, high, bottom = min(latencies) / 1.5, max(latencies) * 1.5, max(lowest - 4, -2)
    axes.set_xlim(low, high)
    axes.set_ylim(bottom, 103)
    axes.set_yticks([tick for tick in axes.get_yticks() if bottom <= tick <= 100])
    _plain_log_axis(axes, low, high)


def _draw_margin(axes: Axes, dense: float, margin: float, color: str) -> None:
    """Draw the line below dense that an interval must stay above."""
    axes.axhline(dense - margin, color=color, linewidth=1, linestyle=(0, (4, 3)), alpha=0.6)
    axes.annotate(
        f"dense − {margin:g} points",
        (axes.get_xlim()[1] / 1.015, dense - margin),
        ha="right",
        va="top",
        fontsize=9,
        color="#666666",
        xytext=(0, -3),
        textcoords="offset points",
    )


def _draw_front(axes: Axes, points: Mapping[str, tuple[float, float]]) -> None:
    """Join the methods that no other beats in both latency and success."""
    front: list[tuple[float, float]] = []
    for latency, rate in sorted(points.values(), key=lambda point: (point[0], -point[1])):
        if not front or rate > front[-1][1]:
            front.append((latency, rate))
    if len(front) > 1:
        axes.step(
            *zip(*front, strict=True),
            where="post",
            color=_FRONT_COLOR,
            linewidth=1.2,
            zorder=1,
            label="Pareto front",
        )


def _verdict_legend(figure: Figure, axes: Axes, methods: Mapping[str, MethodEntry]) -> None:
    from matplotlib.lines import Line2D

    present = {m.judged.verdict for name, m in methods.items() if name != DENSE}
    handles = [
        Line2D([], [], color="#777777", marker=marker, linestyle="", markersize=8, label=verdict)
        for verdict, marker in _MARKERS.items()
        if verdict in present
    ]
    handles += axes.get_legend_handles_labels()[0]
    figure.legend(handles=handles, ncols=len(handles), loc="outside lower center", frameon=False)


def _plain_log_axis(axes: Axes, low: float, high: float) -> None:
    axes.set_xticks(*plain_log_ticks(low, high))
    axes.minorticks_off()


def plain_log_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
    """Return ticks at 1, 2, 5 times powers of ten, with more in between if these are too few, and their labels.

    >>> plain_log_ticks(8, 30)
    ([10.0, 15.0, 20.0, 30.0], ['10', '15', '20', '30'])
    """
    for multiples in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
        ticks = [m * 10.0**e for e in range(-6, 7) for m in multiples if low <= m * 10.0**e <= high]
        if len(ticks) >= 3:
            break
    return sorted(ticks), [f"{tick:g}" for tick in sorted(ticks)]
