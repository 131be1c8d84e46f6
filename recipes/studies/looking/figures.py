"""Figures of when a pruner's masks change with the observation, and of what pruned blocks could reuse."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from recipes.studies.looking.following import Looking
from recipes.studies.looking.reuse_sources import ReuseSources
from torchrl_sparse.blocks.mask import BLOCK_TYPES, TYPE_COLORS
from torchrl_sparse.canvas import make_figure, save_figure

__all__ = ["plot_looking", "plot_reuse_sources"]

_SOURCES = {
    "own": "own block, the step before",
    "type": "latest of its type",
    "query": "own block, the policy call before",
}


def plot_looking(found: Looking, path: str | os.PathLike, *, title: str) -> Path:
    """Draw where masks change over the phases of an episode: one row per phase, one column per cell, step after step.

    Args:
        found: of :func:`~recipes.studies.looking.following.looking`.
        path: of the PNG.
        title: of the figure.
    """
    change = np.array(found.phases)  # [P, K, 3L]
    phases, steps, blocks = change.shape
    figure, axes = make_figure(11, 1.8 + 0.45 * phases)
    image = axes.imshow(
        change.reshape(phases, -1), aspect="auto", cmap="RdBu_r", vmin=-1, vmax=1, interpolation="nearest"
    )
    axes.grid(False)
    axes.set_yticks(range(phases), [f"{number + 1} of {phases}" for number in range(phases)])
    axes.set_ylabel("phase of the episode")
    every = -(-steps // 10)
    axes.set_xticks(np.arange(0, steps, every) * blocks - 0.5, np.arange(0, steps, every))
    axes.set_xlabel(f"denoising step, {blocks} blocks each")
    figure.colorbar(image, ax=axes, label="pruned more often than on average", pad=0.01)
    varying = f"{found.varying_in_episode:.1%} of the cells differ within an episode"
    axes.set_title(f"{title}: {varying}", loc="left")
    return save_figure(figure, path)


def plot_reuse_sources(found: ReuseSources, path: str | os.PathLike, *, title: str) -> Path:
    """Draw how similar each block's output is to each reuse source, mean over the denoising steps after the first.

    Args:
        found: of :func:`~recipes.studies.looking.reuse_sources.reuse_sources`.
        path: of the PNG.
        title: of the figure.
    """
    figure, (panels,) = make_figure(12, 4.2, columns=len(BLOCK_TYPES))
    markers = dict(zip(_SOURCES, "os^", strict=True))
    for kind, axes in enumerate(panels):
        for name, label in _SOURCES.items():
            alike = np.array(getattr(found, name))[kind :: len(BLOCK_TYPES), 1:].mean(axis=1)
            fill = TYPE_COLORS[kind] if name == "own" else "white"
            axes.plot(alike, f"{markers[name]}-", color=TYPE_COLORS[kind], markerfacecolor=fill, label=label)
        axes.set(ylim=(-0.2, 1.02), xlabel="layer", title=BLOCK_TYPES[kind])
    panels[0].set_ylabel("cosine similarity")
    panels[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, x=0.01, ha="left")
    return save_figure(figure, path)
