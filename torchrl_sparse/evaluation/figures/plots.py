"""Figures of a benchmark, each written atomically as a PNG about 900 pixels wide.

Figures are made without pyplot, so that neither a display nor a global state is involved, and matplotlib is
imported only when one is drawn.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_sparse.blocks.mask import BLOCK_TYPES, REUSED_COLOR, TYPE_COLORS
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.colors import method_colors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["block_labels", "plot_error_surge", "plot_schedule", "plot_similarity", "type_legend"]


def block_labels(num_blocks: int, types: Sequence[str] = BLOCK_TYPES) -> list[str]:
    """Return the names of the columns of a mask; ``types`` are the blocks of a layer.

    >>> block_labels(6)
    ['L0 SA', 'L0 CA', 'L0 FFN', 'L1 SA', 'L1 CA', 'L1 FFN']
    """
    return [f"L{index // len(types)} {types[index % len(types)]}" for index in range(num_blocks)]


def type_colors(types: Sequence[str]) -> list[str]:
    """Return the colour of each type of block.

    >>> type_colors(("FFN",)) == [TYPE_COLORS[2]]
    True
    """
    return [TYPE_COLORS[BLOCK_TYPES.index(kind)] for kind in types]


def plot_schedule(
    mask: np.ndarray,
    path: str | os.PathLike,
    *,
    name: str,
    flops_ratio: float | None = None,
    types: Sequence[str] = BLOCK_TYPES,
) -> Path:
    """Draw which blocks are computed at which denoising steps.

    Args:
        mask: bool [K, 3L], True = pruned, steps in execution order.
        path: of the PNG.
        name: of the method, for the title.
        flops_ratio: FLOPs of a policy call over those of the dense policy, for the title.
        types: blocks of a layer.

    Raises:
        InputError: if ``mask`` is not a bool matrix of whole layers.
    """
    from matplotlib.colors import ListedColormap

    mask = _check_mask(mask, "mask", types)
    num_blocks = mask.shape[1]
    figure, axes = make_figure(9, 1.6 + 0.2 * num_blocks)
    # 0 = reused, 1 + type = computed.
    code = np.where(mask, 0, 1 + np.arange(num_blocks) % len(types)).T
    axes.imshow(
        code,
        aspect="auto",
        interpolation="nearest",
        cmap=ListedColormap([REUSED_COLOR, *type_colors(types)]),
        vmin=-0.5,
        vmax=len(types) + 0.5,
    )
    axes.grid(False)
    axes.set_yticks(range(num_blocks), block_labels(num_blocks, types), fontsize=9)
    axes.tick_params(axis="y", length=0)
    for layer in range(1, num_blocks // len(types)):
        axes.axhline(len(types) * layer - 0.5, color="white", linewidth=2)
    axes.xaxis.get_major_locator().set_params(integer=True)  # there is no step 0.5 in a chain of two
    axes.set_xlabel("denoising step, in execution order (0 is the first call of the network)")
    cost = "" if flops_ratio is None else f", {100 * flops_ratio:.1f} % of dense FLOPs"
    axes.set_title(f"{name}: {100 * mask.mean():.1f} % pruned{cost}", loc="left")
    type_legend(figure, types)
    return save_figure(figure, path)


def type_legend(figure: Figure, types: Sequence[str] = BLOCK_TYPES) -> None:
    """Add a legend of a mask's colours below the figure."""
    from matplotlib.patches import Patch

    handles = [
        Patch(color=color, label=f"{kind} computed")
        for kind, color in zip(types, type_colors(types), strict=True)
    ]
    figure.legend(
        handles=[*handles, Patch(color=REUSED_COLOR, label="reused")], ncols=4, loc="outside lower center"
    )


def plot_similarity(
    similarity: np.ndarray, path: str | os.PathLike, types: Sequence[str] = BLOCK_TYPES
) -> Path:
    """Draw the cosine similarity of each block's output between all pairs of denoising steps (figure 1 of BAC,
    arXiv:2506.13456).

    Args:
        similarity: [3L, K, K] cosine similarities.
        path: of the PNG.
        types: blocks of a layer.

    Raises:
        InputError: if the shape is another or a value is not finite.
    """
    similarity, kinds = np.asarray(similarity, dtype=np.float64), len(types)
    if similarity.ndim != 3 or similarity.shape[0] % kinds or similarity.shape[1] != similarity.shape[2]:
        raise InputError(f"similarity: expected shape [{kinds}L, K, K], got {list(similarity.shape)}")
    if not np.isfinite(similarity).all():
        raise InputError("similarity: expected finite values, got NaN or infinity")
    layers, steps = similarity.shape[0] // kinds, similarity.shape[1]
    figure, grid = make_figure(9, 3.9, rows=kinds, columns=layers)
    for index, panel in enumerate(similarity):
        axes = grid[index % kinds, index // kinds]
        image = axes.imshow(panel, vmin=min(similarity.min(), 0.99), vmax=1, cmap="viridis", origin="lower")
        axes.grid(False)
        axes.set_xticks([0, steps - 1])
        axes.set_yticks([0, steps - 1])
        axes.tick_params(
            labelbottom=index % kinds == kinds - 1, labelleft=index < kinds, labelsize=8, length=2
        )
        if index % kinds == 0:
            axes.set_title(f"layer {index // kinds}", fontsize=10)
        if index < kinds:
            axes.set_ylabel(types[index], fontsize=11)
    figure.colorbar(image, ax=grid, shrink=0.9, pad=0.01, label="cosine similarity")
    figure.suptitle("Similarity of a block's output between denoising steps", fontsize=12)
    figure.supxlabel("denoising step, in execution order", fontsize=10)
    figure.supylabel("denoising step", fontsize=10)
    return save_figure(figure, path)


def plot_error_surge(
    errors: Mapping[str, np.ndarray],
    masks: Mapping[str, np.ndarray],
    path: str | os.PathLike,
    types: Sequence[str] = BLOCK_TYPES,
) -> Path:
    """Draw the error of block outputs during a policy call under several schedules (figure 3 of BAC, arXiv:2506.13456).

    Args:
        errors: schedule -> [K, 3L] relative error of every block's output to the dense run on the same noise,
            ``|x - dense| / |dense|``, of one call or the mean of several.
        masks: schedule -> bool [K, 3L], True = pruned; the same names.
        path: of the PNG.
        types: blocks of a layer, of which the last is the FFN.

    Raises:
        InputError: if names or shapes differ.
    """
    if list(errors) != list(masks) or not errors:
        raise InputError(
            f"errors and masks: expected the same schedules, got {list(errors)} and {list(masks)}"
        )
    masks = {name: _check_mask(mask, f"masks[{name!r}]", types) for name, mask in masks.items()}
    for name, error in errors.items():
        if error.shape != masks[name].shape:
            raise InputError(f"errors[{name!r}]: expected shape {masks[name].shape}, got {error.shape}")
    figure, grid = make_figure(9, 6.2, rows=3, columns=1, heights=(3, 3, 0.34 * len(errors)), sharex=True)
    ffn_axes, all_axes, update_axes = grid[:, 0]
    colors = method_colors(errors)
    panels = (
        (ffn_axes, slice(len(types) - 1, None, len(types)), "FFN blocks"),
        (all_axes, slice(None), "all blocks"),
    )
    for axes, blocks, label in panels:
        for name, error in errors.items():
            axes.plot(error[:, blocks].mean(axis=1), color=colors[name], linewidth=1.8, label=name)
        axes.set_ylabel(f"relative error,\nmean of {label}")
        axes.set_ylim(bottom=0)
    ffn_axes.legend(ncols=len(errors), loc="upper left", frameon=False)
    ffn_axes.set_title("Error of the blocks' outputs within a policy call", loc="left")
    _draw_updates(update_axes, masks, colors, len(types))
    update_axes.set_xlabel("denoising step, in execution order")
    return save_figure(figure, path)


def _draw_updates(axes: Axes, masks: Mapping[str, np.ndarray], colors: Mapping[str, str], kinds: int) -> None:
    """Draw one row per schedule; a step is the darker, the more of its FFN blocks are computed there."""
    for row, (name, mask) in enumerate(masks.items()):
        share = (~mask[:, kinds - 1 :: kinds]).mean(axis=1)  # a layer ends with its FFN
        for step in np.flatnonzero(share):
            axes.bar(
                step, 0.8, 1.0, row - 0.4, color=colors[name], alpha=0.15 + 0.85 * share[step], linewidth=0
            )
    axes.set_yticks(range(len(masks)), list(masks), fontsize=9)
    axes.set_ylim(len(masks) - 0.5, -0.5)
    axes.set_xlim(-0.5, len(next(iter(masks.values()))) - 0.5)
    axes.grid(False)
    axes.set_ylabel("FFN\nupdates", rotation=0, ha="right", va="center", labelpad=12)


def _check_mask(mask: Any, name: str, types: Sequence[str]) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.dtype != np.bool_ or mask.ndim != 2 or mask.shape[1] % len(types) or not mask.size:
        raise InputError(
            f"{name}: expected a bool array of shape [K, {len(types)}L], got {mask.dtype} {list(mask.shape)}"
        )
    return mask
