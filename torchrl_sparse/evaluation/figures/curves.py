"""Success as a function of the allowed time: the cost of a slower policy, one picture per task."""

from __future__ import annotations

import os
from pathlib import Path

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.evaluation.results.schema import DENSE, Results

__all__ = ["plot_success_within"]


def plot_success_within(results: Results, path: str | os.PathLike) -> Path:
    """Draw the share of episodes solved within each number of steps (log axis), one curve per method.

    Args:
        results: of a benchmark.
        path: of the PNG.
    """
    from matplotlib.ticker import NullLocator, ScalarFormatter

    curves = {name: method.success_within for name, method in results.methods.items()}
    colors = method_colors(results.methods)
    figure, axes = make_figure(9, 5)
    for name, shares in curves.items():
        steps = sorted(map(int, shares))
        style = {"linewidth": 2.6, "zorder": 3} if name == DENSE else {"linewidth": 1.6}
        axes.plot(steps, [100 * shares[str(step)] for step in steps], color=colors[name], label=name, **style)
    if results.early_cut is not None:
        axes.axvline(results.early_cut, color="#666666", linewidth=1, linestyle=(0, (4, 3)))
        axes.annotate(
            f" early cut, {results.early_cut} steps", (results.early_cut, 101), fontsize=9, color="#666666"
        )
    axes.set_xscale("log")
    axes.set_xticks([step for step in _TICKS if step <= results.episode_horizon])
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlim(_first_success(curves), results.episode_horizon)
    axes.set_ylim(-2, 106)
    axes.set_xlabel("steps allowed (log scale)")
    axes.set_ylabel("episodes solved (%)")
    axes.set_title(f"{results.task}, {results.split} seeds", loc="left")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return save_figure(figure, path)


_TICKS = (10, 20, 30, 50, 70, 100, 150, 200, 300, 400, 700)


def _first_success(curves: dict[str, dict[str, float]]) -> int:
    """Return the last of the times before which no method solves anything."""
    steps = sorted({int(step) for shares in curves.values() for step in shares})
    empty = [step for step in steps if all(shares[str(step)] == 0 for shares in curves.values())]
    return max(empty, default=steps[0]) if len(empty) < len(steps) else steps[0]
