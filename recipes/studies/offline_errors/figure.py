"""Figure of how methods change actions against how they change episodes."""

from __future__ import annotations

import os
from pathlib import Path

from recipes.studies.offline_errors.results import OfflineResults, rank_agreement
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.evaluation.figures.labels import place_labels

__all__ = ["plot_offline"]

_PANELS = {
    "error": "absolute error to demonstrations",
    "energy_score": "energy score of demonstrations",
    "energy_distance": "energy distance to dense",
}


def plot_offline(results: OfflineResults, table: str, path: str | os.PathLike) -> Path:
    """Draw the mean time of a table's methods, as a share of dense's, against three measures of their actions.

    Args:
        results: content of an ``offline_errors_TASK.json``.
        table: one of ``results.played``.
        path: of the PNG.
    """
    played = results.played[table]
    figure, (panels,) = make_figure(15, 5, columns=len(_PANELS))
    colors = method_colors(results.errors)
    for axes, (measure, title) in zip(panels, _PANELS.items(), strict=True):
        points = {name: (getattr(results.errors[name], measure), one.time) for name, one in played.items()}
        for name, point in points.items():
            axes.plot(*point, "o", color=colors[name])
        axes.margins(0.18)
        axes.locator_params(axis="x", nbins=5)
        axes.set_xlabel(f"{title}, normalised")
        agreement = rank_agreement(results, table, measure)
        axes.set_title(f"rank correlation {agreement.time:+.2f}", loc="left", fontsize=11)
    panels[0].set_ylabel(f"{results.task}: mean time to success, of dense's")
    for axes, measure in zip(panels, _PANELS, strict=True):
        points = {name: (getattr(results.errors[name], measure), one.time) for name, one in played.items()}
        bars = {name: (y, y) for name, (_, y) in points.items()}
        place_labels(figure, axes, points, bars, colors, fontsize=8)
    return save_figure(figure, path)
