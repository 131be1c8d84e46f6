"""Figure of what early stopping saves and costs."""

from __future__ import annotations

import os
from pathlib import Path

from recipes.studies.simulate_stopping.results import StoppingResults
from torchrl_sparse.canvas import make_figure, save_figure

__all__ = ["plot_stopping"]

_COLORS = ("#0072B2", "#D55E00", "#009E73")


def plot_stopping(results: StoppingResults, path: str | os.PathLike) -> Path:
    """Draw the episodes saved and the share of significant trials against the true difference: one colour per task.

    Args:
        results: content of a ``stopping.json``.
        path: of the PNG.
    """
    figure, ((left, right),) = make_figure(11, 4.4, columns=2)
    for color, task in zip(_COLORS, dict.fromkeys(case.task for case in results.savings), strict=False):
        cases = [case for case in results.savings if case.task == task]
        points = [100 * case.difference for case in cases]
        left.plot(points, [100 * case.savings.saved for case in cases], "o-", color=color, label=task)
        decided = [100 * (case.savings.non_inferior + case.savings.inferior) for case in cases]
        right.plot(points, decided, "o-", color=color)
        fixed = [100 * case.savings.fixed_non_inferior for case in cases]
        right.plot(points, fixed, "x:", color=color, alpha=0.7)
    left.set_ylabel(f"episodes saved of {results.max_episodes} (%)")
    right.set_ylabel("trials (%)")
    for axes in (left, right):
        axes.set_xlabel("true difference of success rates (points)")
        axes.set_ylim(-3, 103)
    left.set_title(f"{results.analyses} analyses, {results.trials} simulated benchmarks a point", loc="left")
    right.set_title("decided (○), and found non-inferior by all episodes (×)", loc="left")
    left.legend(frameon=False)
    return save_figure(figure, path)
