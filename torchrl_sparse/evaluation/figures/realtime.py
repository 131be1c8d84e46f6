"""Figure of success against simulated inference delay."""

from __future__ import annotations

import os
from pathlib import Path

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.evaluation.results.realtime import Realtime
from torchrl_sparse.evaluation.results.schema import DENSE

__all__ = ["plot_realtime"]


def plot_realtime(results: Realtime, path: str | os.PathLike) -> Path:
    """Draw success, with its interval, against latency; a star marks each method's own latency.

    Args:
        results: what ``realtime.json`` holds.
        path: of the PNG.
    """
    figure, axes = make_figure(9, 5)
    colors, period = method_colors(results.methods), 1e3 / results.control_freq
    for index, (name, method) in enumerate(results.methods.items()):
        # Beside each other, so that the intervals of methods with equal success stay apart.
        shift = (index - (len(results.methods) - 1) / 2) * 0.06 * period
        x = [period * point.delay_steps + shift for point in method.points]
        y = [100 * point.success.rate for point in method.points]
        axes.plot(x, y, "o-", color=colors[name], linewidth=1.8, markersize=5, label=name)
        for at, height, point in zip(x, y, method.points, strict=True):
            interval = [100 * limit for limit in point.success.ci95]
            axes.vlines(at, *interval, color=colors[name], linewidth=2, alpha=0.45)
            if point.own:
                axes.plot(at, height, "*", color=colors[name], markersize=17, zorder=3)
    axes.set_ylim(-2, 103)
    axes.set_xlabel("latency, as the steps that the world makes in it (ms)")
    axes.set_ylabel("success (%), 95 % interval")
    n = results.methods[DENSE].points[0].success.n
    axes.set_title(f"{results.task}: {n} paired episodes; a star is a method's own latency", loc="left")
    axes.legend(loc="lower left", frameon=False)
    return save_figure(figure, path)
