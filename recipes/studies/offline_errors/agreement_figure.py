"""Figure of which offline measure predicts episode results, table by table."""

from __future__ import annotations

import os
from pathlib import Path

from recipes.studies.offline_errors.agreement import OfflineAgreement
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors

__all__ = ["plot_agreement"]

_TITLES = {"success": "with success", "time": "with time to success"}


def plot_agreement(agreement: OfflineAgreement, path: str | os.PathLike) -> Path:
    """Draw, for each measure, each table's rank correlation as a dot and the overall one as a bar.

    Args:
        agreement: content of an ``offline_agreement.json``.
        path: of the PNG.
    """
    figure, (panels,) = make_figure(13, 5, columns=len(_TITLES))
    colors = method_colors(agreement.methods)
    for axes, (outcome, title) in zip(panels, _TITLES.items(), strict=True):
        found = getattr(agreement, outcome)
        for place, one in enumerate(found.values()):
            axes.plot([place - 0.3, place + 0.3], [one.together] * 2, color="#333333", linewidth=2.5)
            for number, (table, value) in enumerate(one.tables.items()):
                shift = 0.12 * (number - (len(one.tables) - 1) / 2)
                axes.plot(place + shift, value, "o", color=colors[table], label=None if place else table)
        labels = [f"{name.replace('_', ' ')}\n{_chance(one.p)}" for name, one in found.items()]
        axes.set_xticks(range(len(found)), labels)
        axes.set_ylim(-1.08, 1.08)
        axes.axhline(0, color="#9A9AA0", linewidth=1)
        axes.set_title(f"rank correlation {title}", loc="left")
    panels[0].legend(frameon=False, loc="lower left", fontsize=9)
    return save_figure(figure, path)


def _chance(p: float) -> str:
    return "p < 0.001" if p < 1e-3 else f"p = {p:.3f}"
