"""Common style of all figures, without pyplot, and atomic saving."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_sparse.storage.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["make_figure", "save_figure"]

_STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E7",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "figure.dpi": 100,
}


def make_figure(
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    heights: tuple[float, ...] | None = None,
    sharex: bool = False,
) -> tuple["Figure", Any]:
    """Make a styled figure ``width * 100`` pixels wide and its axes: one, or an array [rows, columns]."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex, height_ratios=heights)
    return figure, axes[0, 0] if rows == columns == 1 else axes


def save_figure(figure: "Figure", path: str | os.PathLike) -> Path:
    """Write the figure as a PNG and return the path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, facecolor="white")
    return Path(path)
