"""Figures of masks along a rollout: the strip, the averages, and the panel of a video."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_sparse.blocks.mask import BLOCK_TYPES, REUSED_COLOR
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.plots import block_labels, type_colors, type_legend

__all__ = ["mask_panel", "plot_mask_statistics", "plot_mask_strip"]

_PANELS = 8


def plot_mask_strip(
    masks: np.ndarray,
    path: str | os.PathLike,
    *,
    name: str,
    steps_per_query: int,
    types: Sequence[str] = BLOCK_TYPES,
) -> Path:
    """Draw the masks of policy calls along one rollout, side by side (figure 5 of SAG, arXiv:2601.12894).

    Args:
        masks: bool [Q, K, 3L], True = pruned, calls in order; eight of them are drawn, evenly spread.
        path: of the PNG.
        name: of the method, for the title.
        steps_per_query: environment steps from one call to the next.
        types: blocks of a layer.

    Raises:
        InputError: if ``masks`` is not such an array.
    """
    masks = _check_masks(masks, types)
    shown = np.unique(np.linspace(0, len(masks) - 1, _PANELS).round().astype(int))
    figure, grid = make_figure(9, 4.6, rows=1, columns=len(shown))
    panels = np.atleast_1d(grid).reshape(-1)
    for axes, query in zip(panels, shown, strict=True):
        axes.imshow(_colors(masks[query], types), aspect="auto", interpolation="nearest")
        axes.grid(False)
        axes.set_xticks([])
        axes.tick_params(labelleft=query == 0, labelsize=9, length=2)
        pruned = 100 * masks[query].mean()
        axes.set_title(f"step {query * steps_per_query}\n{pruned:.1f} %", fontsize=9)
    panels[0].set_ylabel("denoising step (0 is the first)")
    panels[len(panels) // 2].set_xlabel(
        f"blocks, layer 0 to {masks.shape[2] // len(types) - 1} from left to right"
    )
    figure.suptitle(f"{name}: masks along a rollout, environment step and share pruned", fontsize=12)
    type_legend(figure, types)
    return save_figure(figure, path)


def plot_mask_statistics(
    masks: np.ndarray, path: str | os.PathLike, *, name: str, types: Sequence[str] = BLOCK_TYPES
) -> Path:
    """Draw where a planner prunes, and how much each cell depends on the observation.

    Above: the pruned share of each type of block along the denoising steps. Below: the variance over policy calls of every
    entry of the mask, 0 where it is always the same and 0.25 where it is a toss of a coin.

    Args:
        masks: bool [Q, K, 3L], True = pruned, of many calls.
        path: of the PNG.
        name: of the method, for the title.
        types: blocks of a layer.

    Raises:
        InputError: if ``masks`` is not such an array.
    """
    masks = _check_masks(masks, types)
    num_blocks = masks.shape[2]
    figure, grid = make_figure(9, 6.4, rows=2, columns=1, heights=(1.1, 2), sharex=True)
    above, below = grid[:, 0]
    for kind, color in enumerate(type_colors(types)):
        share = 100 * masks[:, :, kind :: len(types)].mean(axis=(0, 2))
        above.plot(share, color=color, label=types[kind], linewidth=2)
    above.set_ylim(-3, 103)
    above.set_ylabel("pruned (%)")
    above.legend(ncols=3, loc="lower right")
    variance = masks.mean(axis=0) * (1 - masks.mean(axis=0))
    above.set_title(
        f"{name}: {100 * masks.mean():.1f} % pruned, {len(masks)} policy calls; mean variance {variance.mean():.4f}",
        loc="left",
    )
    image = below.imshow(variance.T, aspect="auto", interpolation="nearest", vmin=0, vmax=0.25, cmap="magma")
    below.grid(False)
    below.set_yticks(range(num_blocks), block_labels(num_blocks, types), fontsize=8)
    below.set_xlabel("denoising step, in execution order (0 is the first call of the network)")
    figure.colorbar(image, ax=below, pad=0.01, label="variance over policy calls")
    return save_figure(figure, path)


def mask_panel(mask: np.ndarray, height: int, types: Sequence[str] = BLOCK_TYPES) -> np.ndarray:
    """Make an image of a mask for a video: steps from top to bottom, blocks from left to right.

    Args:
        mask: bool [K, 3L], True = pruned.
        height: of the image, in pixels.
        types: blocks of a layer.

    Returns:
        u8 [height, 4 * 3L, 3].

    >>> mask_panel(np.zeros((100, 24), bool), height=320).shape
    (320, 96, 3)
    """
    rows = np.arange(height) * len(mask) // height
    return (255 * _colors(mask, types)[rows].repeat(4, axis=1)).round().astype(np.uint8)


def _colors(mask: np.ndarray, types: Sequence[str]) -> np.ndarray:
    """Return f64 [K, 3L, 3]: the colour of the type where a block is computed, grey where it is reused."""
    from matplotlib.colors import to_rgb

    colors = type_colors(types)
    computed = np.array([to_rgb(colors[block % len(types)]) for block in range(mask.shape[1])])
    return np.where(mask[..., None], np.array(to_rgb(REUSED_COLOR)), computed)


def _check_masks(masks: np.ndarray, types: Sequence[str]) -> np.ndarray:
    masks = np.asarray(masks)
    if masks.dtype != bool or masks.ndim != 3 or not len(masks) or masks.shape[2] % len(types):
        raise InputError(
            f"masks: expected bool [Q > 0, K, {len(types)}L], got {masks.dtype} {list(masks.shape)}"
        )
    return masks
