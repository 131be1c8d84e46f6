"""Figures of visual-token pruning: which tokens were kept, through how many layers, and how that followed the hand's speed."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.methods.token_budget import TokenBudget

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_tokens", "plot_control", "plot_token_budgets", "plot_token_strip", "plot_tokens_per_layer"]

_GONE = np.array((24, 24, 28), np.float32)
_DIMMEST = 0.18  # of the image still shows through a token that was dropped before the decoder
_SPEED, _FINE, _QUERY = "#0072B2", "#F2C14E", "#D55E00"


def draw_tokens(images: np.ndarray, depth: np.ndarray, num_layers: int, scale: int = 1) -> np.ndarray:
    """Draw the cameras side by side, darkening each patch more the earlier its token was dropped; kept patches are unchanged.

    Args:
        images: u8 [V, 3, h, w], a policy call's images.
        depth: [N], decoder layers that each visual token reached (``("tokens", "depth")``), camera by camera.
        num_layers: decoder layers; the depth of tokens that were never dropped.
        scale: pixels of the picture for one of the image.

    Returns:
        u8 [h * scale, V * w * scale, 3].

    Raises:
        InputError: if the tokens of a camera form no square grid that divides the image.

    Examples:
        >>> images = np.full((2, 3, 4, 4), 200, np.uint8)
        >>> picture = draw_tokens(images, np.array([4, 0, 2, 4, 4, 4, 4, 4]), num_layers=4)
        >>> picture.shape, picture[0, :, 0].tolist()
        ((4, 8, 3), [200, 200, 56, 56, 200, 200, 200, 200])
    """
    cameras, _, height, width = images.shape
    side = round((len(depth) / cameras) ** 0.5)
    if cameras * side**2 != len(depth) or height % side or width % side:
        raise InputError(
            f"depth: expected a square grid of tokens for each of {cameras} images of {height} x {width} that divides "
            f"them, got {len(depth)} tokens"
        )
    light = _DIMMEST + (1 - _DIMMEST) * np.clip(np.asarray(depth, np.float32) / num_layers, 0, 1)
    pictures = []
    for image, grid in zip(images, light.reshape(cameras, side, side), strict=True):
        mask = grid.repeat(height // side, 0).repeat(width // side, 1)[..., None]
        pictures.append(np.moveaxis(image, 0, -1) * mask + _GONE * (1 - mask))
    picture = np.concatenate(pictures, 1).round().astype(np.uint8)
    return picture.repeat(scale, 0).repeat(scale, 1)


def plot_token_strip(pictures: Sequence[np.ndarray], labels: Sequence[str], path: str | os.PathLike) -> Path:
    """Draw pictures of `draw_tokens` along a rollout, from left to right, one row per camera.

    Args:
        pictures: u8 [h, V * w, 3], one per policy call that is shown; the V images of each are square.
        labels: what to write above each.
        path: of the PNG.

    Raises:
        InputError: if there is nothing to show, or labels do not match.
    """
    if not len(pictures) or len(pictures) != len(labels):
        raise InputError(
            f"pictures: expected at least one and a label for each, got {len(pictures)} and {len(labels)}"
        )
    cameras = pictures[0].shape[1] // pictures[0].shape[0]
    size = 9 / len(pictures)
    figure, grid = make_figure(9, cameras * size + 0.6, rows=cameras, columns=len(pictures))
    grid = np.reshape(grid, (cameras, len(pictures)))
    for column, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        grid[0, column].set_title(label, fontsize=9)
        for row, image in enumerate(np.split(picture, cameras, axis=1)):
            grid[row, column].imshow(image)
            grid[row, column].set_axis_off()
    return save_figure(figure, path)


def plot_control(
    speed: np.ndarray,
    fine: np.ndarray,
    queried: np.ndarray,
    path: str | os.PathLike,
    *,
    kept: np.ndarray | None = None,
) -> Path:
    """Draw the fine-mode phases over the hand's speed, with policy calls marked.

    Args:
        speed: [T] m/s at each step.
        fine, queried: bool [T].
        path: of the PNG.
        kept: [T] visual tokens of the latest call, drawn below.

    Raises:
        InputError: if lengths differ.
    """
    series = {"fine": fine, "queried": queried, **({} if kept is None else {"kept": kept})}
    for name, values in series.items():
        if len(values) != len(speed):
            raise InputError(f"{name}: expected {len(speed)} steps like speed, got {len(values)}")
    rows = 1 if kept is None else 2
    figure, grid = make_figure(9, 2.2 + 1.6 * rows, rows=rows, columns=1, sharex=True)
    axes = [grid] if kept is None else grid[:, 0]
    steps = np.arange(len(speed))
    axes[0].plot(steps, speed, color=_SPEED, linewidth=1.8, label="speed of the hand")
    axes[0].plot(steps[queried], speed[queried], "o", color=_QUERY, markersize=5, label="query")
    axes[0].set_ylabel("m/s")
    if kept is not None:
        axes[1].step(steps, kept, where="post", color="#333333", linewidth=1.6)
        axes[1].set_ylabel("visual tokens kept")
    for index, panel in enumerate(axes):
        panel.fill_between(
            steps, 0, 1, where=fine, transform=panel.get_xaxis_transform(), color=_FINE, alpha=0.35, step="post",
            linewidth=0, label="fine mode" if index == 0 else None,
        )  # fmt: skip
        panel.set_ylim(bottom=0)
    axes[0].legend(frameon=False, ncols=3, loc="upper right")
    axes[-1].set_xlabel("environment step")
    axes[-1].locator_params(axis="x", integer=True)
    return save_figure(figure, path)


def plot_tokens_per_layer(depth: dict[str, np.ndarray], num_layers: int, path: str | os.PathLike) -> Path:
    """Draw the number of visual tokens in each decoder layer, mean over policy calls, for several methods.

    Args:
        depth: method -> [calls, N] layers that each token reached (``("tokens", "depth")``).
        num_layers: decoder layers.
        path: of the PNG.

    Raises:
        InputError: if there is no method, or one without calls.
    """
    if not depth or any(np.ndim(values) != 2 or not np.size(values) for values in depth.values()):
        shapes = {name: list(np.shape(values)) for name, values in depth.items()}
        raise InputError(f"depth: expected [policy calls, N] for at least one method, got {shapes}")
    figure, axes = make_figure(9, 3.8)
    colors = method_colors(depth)
    for place, (name, values) in enumerate(depth.items()):
        per_layer = [(np.asarray(values) > layer).sum(1).mean() for layer in range(num_layers)]
        # Methods that keep the same lie on top of each other, so each line is thinner than those below it.
        width = 1.5 + 4.5 * (len(depth) - 1 - place) / len(depth)
        axes.step(range(num_layers), per_layer, where="mid", linewidth=width, color=colors[name], label=name)
    axes.set_xlabel("decoder layer")
    axes.set_ylabel("visual tokens, mean")
    axes.set_ylim(bottom=0)
    figure.legend(frameon=False, loc="outside right center")
    return save_figure(figure, path)


def plot_token_budgets(budgets: Sequence[TokenBudget], path: str | os.PathLike) -> Path:
    """Draw loss against kept tokens for every budget of each method, with the tolerance and the choice.

    One curve or two have their numbers beside them; of more, which would cover each other's, the legend says the chosen.

    Args:
        budgets: calibrated by one measure, of different methods.
        path: of the PNG.

    Raises:
        InputError: if there is none, or they were calibrated by different measures.
    """
    measures = sorted({budget.measure for budget in budgets})
    if len(measures) != 1:
        raise InputError(f"budgets: expected one measure, got {', '.join(measures) or 'no budget'}")
    figure, axes = make_figure(9, 4.2)
    colors = method_colors(budget.method for budget in budgets)
    above, below = (4, 6), (-6, -15)
    for index, budget in enumerate(budgets):
        offset = None if len(budgets) > 2 else (above, below)[index]
        _draw_budget(axes, budget, colors[budget.method], offset)
    for tolerance in sorted({budget.tolerance for budget in budgets}):
        axes.axhline(tolerance, color="#333333", linewidth=1, linestyle="--", label="tolerance")
    axes.set_xlabel("visual tokens in a decoder layer, mean")
    axes.set_ylabel("action error" if measures == ["action_error"] else "success lost")
    low, high = axes.get_ylim()
    axes.set_ylim(bottom=min(0, low) - 0.05 * high)  # room for numbers below a curve that comes close to zero
    axes.legend(frameon=False)
    return save_figure(figure, path)


def _draw_budget(axes: Axes, budget: TokenBudget, color: str, offset: tuple[int, int] | None) -> None:
    """Draw one curve, with its numbers that many points from theirs."""
    points = sorted(budget.points, key=lambda point: point.kept)
    axes.plot([p.kept for p in points], [p.loss for p in points], "o-", color=color, linewidth=1.8)
    for point in points:
        place, text = (point.kept, point.loss), f"{point.number:g}"
        if offset is not None:
            axes.annotate(text, place, offset, textcoords="offset points", fontsize=9, color=color)
        if point.number == budget.number:
            chosen = f"chosen: {budget.method}@{text}"
            axes.plot(*place, "o", color=color, markeredgecolor="#333333", markersize=11, label=chosen)
