"""The figures of a benchmark, each written atomically as a PNG about 900 pixels wide.

Figures are made without pyplot, so that neither a display nor a global state is involved, and matplotlib is
imported only when one is drawn.
"""

import itertools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_sparse.evaluation.figures.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.labels import place_labels
from torchrl_sparse.evaluation.results.schema import REFERENCE, validate_results
from torchrl_sparse.methods.diffusion import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["block_labels", "plot_error_surge", "plot_pareto", "plot_schedule", "plot_similarity"]

BLOCK_TYPES = ("SA", "CA", "FFN")
TYPE_COLORS = ("#0072B2", "#009E73", "#D55E00")
REUSED_COLOR = "#E9E9EC"
_FRONT_COLOR = "#B5B5BA"
# For methods whose table names no colour.
_OTHER_COLORS = (
    *("#009E73", "#8C6BB1", "#A6761D", "#B2182B", "#4D4D4D", "#66A61E"),
    *("#E7298A", "#1B7F79", "#BCBD22", "#3F2A8C", "#F46D43", "#74A9CF"),
    *("#7A4B2A", "#9E9AC8", "#FB9A99", "#00441B"),
)
_MARKERS = {"non-inferior": "o", "undecided": "D", "inferior": "X"}


def block_labels(num_blocks: int) -> list[str]:
    """Names of the columns of a mask.

    >>> block_labels(6)
    ['L0 SA', 'L0 CA', 'L0 FFN', 'L1 SA', 'L1 CA', 'L1 FFN']
    """
    return [f"L{index // 3} {BLOCK_TYPES[index % 3]}" for index in range(num_blocks)]


def plot_pareto(results: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Success, with its interval, against the median latency of a query (log axis); marker by verdict.

    Args:
        results: content of a ``results.json``.
        path: of the PNG.

    Raises:
        ValueError: if ``results`` is not of the schema.
    """
    validate_results(results)
    methods = results["methods"]
    figure, axes = make_figure(9, 5)
    latency = {name: 1e3 * method["latency_s"]["p50"] for name, method in methods.items()}
    rate = {name: 100 * method["success"]["rate"] for name, method in methods.items()}
    colors = method_colors(methods)
    axes.set_xscale("log")
    intervals = {name: [100 * limit for limit in m["success"]["ci95"]] for name, m in methods.items()}
    for name, method in methods.items():
        axes.vlines(latency[name], *intervals[name], color=colors[name], linewidth=2, alpha=0.55)
        marker = "s" if name == REFERENCE else _MARKERS[method["paired_vs_dense"]["verdict"]]
        axes.plot(latency[name], rate[name], marker, color=colors[name], markersize=9, zorder=3)
    _draw_front(axes, latency, rate)
    margin = 100 * methods[REFERENCE]["paired_vs_dense"]["margin"]
    axes.axhline(
        rate[REFERENCE] - margin,
        color=METHODS[REFERENCE].color,
        linewidth=1,
        linestyle=(0, (4, 3)),
        alpha=0.6,
    )
    low, high = min(latency.values()), max(latency.values())
    axes.set_xlim(low / 1.5, high * 1.5)
    bottom = min(low for low, _ in intervals.values())
    axes.set_ylim(max(bottom - 4, -2), 103)
    axes.set_yticks([tick for tick in axes.get_yticks() if max(bottom - 4, -2) <= tick <= 100])
    axes.annotate(
        f"dense − {margin:g} points",
        (high * 1.48, rate[REFERENCE] - margin),
        ha="right",
        va="top",
        fontsize=9,
        color="#666666",
        xytext=(0, -3),
        textcoords="offset points",
    )
    _plain_log_axis(axes, low / 1.5, high * 1.5)
    axes.set_xlabel("latency per query, median (ms, log scale)")
    axes.set_ylabel("success (%), 95 % interval")
    n, machine = methods[REFERENCE]["success"]["n"], results["machine"]
    threads = f"{machine['threads']} thread{'' if machine['threads'] == 1 else 's'}"
    axes.set_title(f"{results['task']}: {n} paired episodes; {machine['cpu']}, {threads}", loc="left")
    _verdict_legend(figure, axes, methods)
    points = {name: (latency[name], rate[name]) for name in methods}
    place_labels(figure, axes, points, intervals, colors)
    return save_figure(figure, path)


def plot_schedule(
    mask: np.ndarray, path: str | os.PathLike, *, name: str, flops_ratio: float | None = None
) -> Path:
    """Which block is computed at which denoising step.

    Args:
        mask: bool [K, 3L], True = pruned, steps in execution order.
        path: of the PNG.
        name: of the method, for the title.
        flops_ratio: FLOPs of a query over those of the dense policy, for the title.

    Raises:
        ValueError: if ``mask`` is not a bool matrix with a multiple of three columns.
    """
    from matplotlib.colors import ListedColormap

    mask = _check_mask(mask, "mask")
    num_blocks = mask.shape[1]
    figure, axes = make_figure(9, 1.6 + 0.2 * num_blocks)
    # 0 = reused, 1 + type = computed.
    code = np.where(mask, 0, 1 + np.arange(num_blocks) % 3).T
    axes.imshow(
        code,
        aspect="auto",
        interpolation="nearest",
        cmap=ListedColormap([REUSED_COLOR, *TYPE_COLORS]),
        vmin=-0.5,
        vmax=3.5,
    )
    axes.grid(False)
    axes.set_yticks(range(num_blocks), block_labels(num_blocks), fontsize=9)
    axes.tick_params(axis="y", length=0)
    for layer in range(1, num_blocks // 3):
        axes.axhline(3 * layer - 0.5, color="white", linewidth=2)
    axes.xaxis.get_major_locator().set_params(integer=True)  # there is no step 0.5 in a chain of two
    axes.set_xlabel("denoising step, in execution order (0 is the first call of the network)")
    cost = "" if flops_ratio is None else f", {100 * flops_ratio:.1f} % of dense FLOPs"
    axes.set_title(f"{name}: {100 * mask.mean():.1f} % pruned{cost}", loc="left")
    type_legend(figure)
    return save_figure(figure, path)


def type_legend(figure: "Figure") -> None:
    """What the colours of a mask mean, under the figure."""
    from matplotlib.patches import Patch

    handles = [
        Patch(color=color, label=f"{kind} computed")
        for kind, color in zip(BLOCK_TYPES, TYPE_COLORS, strict=True)
    ]
    figure.legend(
        handles=[*handles, Patch(color=REUSED_COLOR, label="reused")], ncols=4, loc="outside lower center"
    )


def plot_similarity(similarity: np.ndarray, path: str | os.PathLike) -> Path:
    """Cosine similarity of each block's output between all pairs of denoising steps (figure 1 of BAC,
    arXiv:2506.13456).

    Args:
        similarity: [3L, K, K] cosine similarities.
        path: of the PNG.

    Raises:
        ValueError: if the shape is another or a value is not finite.
    """
    similarity = np.asarray(similarity, dtype=np.float64)
    if similarity.ndim != 3 or similarity.shape[0] % 3 or similarity.shape[1] != similarity.shape[2]:
        raise ValueError(f"similarity: expected shape [3L, K, K], got {list(similarity.shape)}")
    if not np.isfinite(similarity).all():
        raise ValueError("similarity: expected finite values, got NaN or infinity")
    layers, steps = similarity.shape[0] // 3, similarity.shape[1]
    figure, grid = make_figure(9, 3.9, rows=3, columns=layers)
    for index, panel in enumerate(similarity):
        axes = grid[index % 3, index // 3]
        image = axes.imshow(panel, vmin=min(similarity.min(), 0.99), vmax=1, cmap="viridis", origin="lower")
        axes.grid(False)
        axes.set_xticks([0, steps - 1])
        axes.set_yticks([0, steps - 1])
        axes.tick_params(labelbottom=index % 3 == 2, labelleft=index < 3, labelsize=8, length=2)
        if index % 3 == 0:
            axes.set_title(f"layer {index // 3}", fontsize=10)
        if index < 3:
            axes.set_ylabel(BLOCK_TYPES[index % 3], fontsize=11)
    figure.colorbar(image, ax=grid, shrink=0.9, pad=0.01, label="cosine similarity")
    figure.suptitle("Similarity of a block's output between denoising steps", fontsize=12)
    figure.supxlabel("denoising step, in execution order", fontsize=10)
    figure.supylabel("denoising step", fontsize=10)
    return save_figure(figure, path)


def plot_error_surge(
    errors: Mapping[str, np.ndarray], masks: Mapping[str, np.ndarray], path: str | os.PathLike
) -> Path:
    """Error of the blocks' outputs along one query under several schedules (figure 3 of BAC,
    arXiv:2506.13456).

    Args:
        errors: schedule -> [K, 3L] relative error of every block's output to the dense run on the same noise,
            ``|x - dense| / |dense|``.
        masks: schedule -> bool [K, 3L], True = pruned; the same names.
        path: of the PNG.

    Raises:
        ValueError: if names or shapes differ.
    """
    if list(errors) != list(masks) or not errors:
        raise ValueError(
            f"errors and masks: expected the same schedules, got {list(errors)} and {list(masks)}"
        )
    masks = {name: _check_mask(mask, f"masks[{name!r}]") for name, mask in masks.items()}
    for name, error in errors.items():
        if error.shape != masks[name].shape:
            raise ValueError(f"errors[{name!r}]: expected shape {masks[name].shape}, got {error.shape}")
    figure, grid = make_figure(9, 6.2, rows=3, columns=1, heights=(3, 3, 0.34 * len(errors)), sharex=True)
    ffn_axes, all_axes, update_axes = grid[:, 0]
    colors = method_colors(errors)
    panels = ((ffn_axes, slice(2, None, 3), "FFN blocks"), (all_axes, slice(None), "all blocks"))
    for axes, blocks, label in panels:
        for name, error in errors.items():
            axes.plot(error[:, blocks].mean(axis=1), color=colors[name], linewidth=1.8, label=name)
        axes.set_ylabel(f"relative error,\nmean of {label}")
        axes.set_ylim(bottom=0)
    ffn_axes.legend(ncols=len(errors), loc="upper left", frameon=False)
    ffn_axes.set_title("Error of the blocks' outputs along one query", loc="left")
    _draw_updates(update_axes, masks, colors)
    update_axes.set_xlabel("denoising step, in execution order")
    return save_figure(figure, path)


def _draw_updates(axes: "Axes", masks: Mapping[str, np.ndarray], colors: Mapping[str, str]) -> None:
    """One row per schedule; a step is the darker, the more of its FFN blocks are computed there."""
    for row, (name, mask) in enumerate(masks.items()):
        share = (~mask[:, 2::3]).mean(axis=1)
        for step in np.flatnonzero(share):
            axes.bar(
                step, 0.8, 1.0, row - 0.4, color=colors[name], alpha=0.15 + 0.85 * share[step], linewidth=0
            )
    axes.set_yticks(range(len(masks)), list(masks), fontsize=9)
    axes.set_ylim(len(masks) - 0.5, -0.5)
    axes.set_xlim(-0.5, len(next(iter(masks.values()))) - 0.5)
    axes.grid(False)
    axes.set_ylabel("FFN\nupdates", rotation=0, ha="right", va="center", labelpad=12)


def _draw_front(axes: "Axes", latency: Mapping[str, float], rate: Mapping[str, float]) -> None:
    """Join the methods that no other beats in both latency and success."""
    front = []
    for name in sorted(latency, key=lambda name: (latency[name], -rate[name])):
        if not front or rate[name] > rate[front[-1]]:
            front.append(name)
    if len(front) > 1:
        axes.step(
            [latency[name] for name in front],
            [rate[name] for name in front],
            where="post",
            color=_FRONT_COLOR,
            linewidth=1.2,
            zorder=1,
            label="Pareto front",
        )


def _verdict_legend(figure: "Figure", axes: "Axes", methods: Mapping[str, Any]) -> None:
    from matplotlib.lines import Line2D

    present = {m["paired_vs_dense"]["verdict"] for name, m in methods.items() if name != REFERENCE}
    handles = [
        Line2D([], [], color="#777777", marker=marker, linestyle="", markersize=8, label=verdict)
        for verdict, marker in _MARKERS.items()
        if verdict in present
    ]
    handles += axes.get_legend_handles_labels()[0]
    figure.legend(handles=handles, ncols=len(handles), loc="outside lower center", frameon=False)


def _plain_log_axis(axes: "Axes", low: float, high: float) -> None:
    """Ticks at 1, 2, 5 times powers of ten, and between them where that makes too few, in plain numbers."""
    for multiples in ((1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7)):
        ticks = [m * 10.0**e for e in range(-6, 7) for m in multiples if low <= m * 10.0**e <= high]
        if len(ticks) >= 3:
            break
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """Return name -> colour: that of `METHODS`, the same one in every figure, or one that is left."""
    others = itertools.cycle(_OTHER_COLORS)
    named = {name: METHODS[name].color for name in methods if name in METHODS}
    return {name: named.get(name) or next(others) for name in methods}


def _check_mask(mask: Any, name: str) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.dtype != np.bool_ or mask.ndim != 2 or mask.shape[1] % 3 or not mask.size:
        raise ValueError(
            f"{name}: expected a bool array of shape [K, 3L], got {mask.dtype} {list(mask.shape)}"
        )
    return mask
