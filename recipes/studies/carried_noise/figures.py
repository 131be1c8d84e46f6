"""Figure of how strongly predictions depend on the initial noise."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from recipes.studies.carried_noise.results import CarriedNoiseResults
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.colors import method_colors

__all__ = ["plot_carried_noise"]


def plot_carried_noise(results: CarriedNoiseResults, path: str | os.PathLike) -> Path:
    """Draw each step's correlation with the initial noise, and the spread and error of the final actions.

    Args:
        results: content of a ``carried_noise_TASK.json``.
        path: of the PNG.
    """
    figure, ((left, right),) = make_figure(12, 4.6, columns=2)
    colors = method_colors(results.chains)
    for name, chain in results.chains.items():
        marker = "." if len(chain.timesteps) > 20 else "o"
        left.plot(chain.timesteps, chain.correlation, f"{marker}-", color=colors[name], label=name)
    lowest = min(-0.1, *(min(chain.correlation) - 0.05 for chain in results.chains.values()))
    left.set(xlim=(102, -3), ylim=(lowest, 1.0), xlabel="timestep of the denoising step")
    left.set_ylabel("correlation with the first noise")
    left.set_title(f"{results.task}: the clean prediction of every step", loc="left")
    left.legend(frameon=False, fontsize=9, ncols=2)

    rows = np.arange(len(results.chains))
    for offset, field, hatch in ((-0.2, "spread", None), (0.2, "error", "//")):
        values = [getattr(chain, field) for chain in results.chains.values()]
        right.barh(
            rows + offset, values, 0.38, color=[*colors.values()], hatch=hatch, edgecolor="white", linewidth=0
        )
        for row, value in zip(rows, values, strict=True):
            right.text(value, row + offset, f" {value:.3f}", va="center", fontsize=8)
    right.set_yticks(rows, [*results.chains])
    right.invert_yaxis()
    right.set_xlabel("normalised actions, root mean square")
    right.set_title(
        "spread between draws (plain), error to demonstrations (hatched)", loc="left", fontsize=11
    )
    return save_figure(figure, path)
