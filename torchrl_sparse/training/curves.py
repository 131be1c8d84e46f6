"""Training curves of a pruner: fidelity loss and sparsity."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchrl_sparse.blocks.mask import BLOCK_TYPES, TYPE_COLORS
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.errors import InputError

__all__ = ["plot_pruner_curves", "read_scalars"]


def read_scalars(folder: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read all scalars written by TorchRL's CSV logger: name -> f64 [n, 2] of step and value.

    A training that was killed and resumed logs the steps since its checkpoint twice; the later entry counts.

    Args:
        folder: the logger's, with a folder ``scalars``.

    Raises:
        FileNotFoundError: if there is no such folder.
    """
    scalars = Path(folder) / "scalars"
    if not scalars.is_dir():
        raise FileNotFoundError(f"expected a folder {scalars}, got none")
    curves = {}
    for path in sorted(scalars.rglob("*.csv")):
        entries = np.atleast_2d(np.loadtxt(path, delimiter=","))
        latest = dict(entries.tolist())
        curves[path.relative_to(scalars).with_suffix("").as_posix()] = np.array(sorted(latest.items()))
    return curves


def plot_pruner_curves(curves: Mapping[str, np.ndarray], path: str | os.PathLike, *, rate: float) -> Path:
    """Draw fidelity loss and held-out error, prune rate, and pruned share per block type, over the updates.

    Args:
        curves: of :func:`read_scalars`, with ``train/fidelity``, ``train/rate``, ``train/rate_cost`` and
            ``train/rate_<type>``; ``held_out/error`` and ``held_out/rate_cost`` are drawn where they are there.
        path: of the PNG.
        rate: the target.

    Raises:
        InputError: if a curve is missing.
    """
    types = [kind for kind in BLOCK_TYPES if kind != "CA" or f"train/rate_{kind}" in curves]
    needed = ["train/fidelity", "train/rate_cost", *(f"train/rate_{kind}" for kind in types)]
    if missing := [name for name in needed if name not in curves]:
        raise InputError(f"curves: expected {needed}, missing {missing}")
    figure, grid = make_figure(9, 6.6, rows=3, columns=1, sharex=True)
    fidelity, sparsity, shares = grid[:, 0]
    fidelity.plot(*curves["train/fidelity"].T, color="#0072B2", alpha=0.7, label="training batches")
    _plot_held_out(fidelity, curves.get("held_out/error"))
    fidelity.set_yscale("log")
    fidelity.set_ylabel("action error")
    fidelity.legend(loc="upper right")
    sparsity.plot(*_percent(curves["train/rate_cost"]), color="#0072B2", alpha=0.7)
    held_out = curves.get("held_out/rate_cost")
    _plot_held_out(sparsity, None if held_out is None else np.stack(_percent(held_out), axis=1))
    sparsity.axhline(100 * rate, color="#333333", linestyle=(0, (4, 3)), linewidth=1)
    sparsity.set_ylabel("cost pruned (%)")
    for kind in types:
        color = TYPE_COLORS[BLOCK_TYPES.index(kind)]
        shares.plot(*_percent(curves[f"train/rate_{kind}"]), color=color, label=kind)
    shares.set_ylabel("blocks pruned (%)")
    shares.set_xlabel("update")
    shares.legend(ncols=3, loc="lower right")
    return save_figure(figure, path)


def _plot_held_out(axes, curve: np.ndarray | None) -> None:
    if curve is not None:
        axes.plot(*curve.T, "o", color="#D55E00", markersize=4, label="held-out observations")


def _percent(curve: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return curve[:, 0], 100 * curve[:, 1]
