"""Figure of the modes that each method's episodes take, to show whether an accelerated policy loses modes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.envs.seeded import BETWEEN, NO_WAY
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.evaluation.statistics.ways import way_entropy

__all__ = ["plot_ways", "count_modes"]

_COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#8C6BB1")  # of ways, from 0 on
_OTHERS = {BETWEEN: ("went between", "#B2182B"), NO_WAY: ("none", "#D0D0D4")}


def count_modes(episodes: Mapping[str, Sequence[EpisodeResult]]) -> dict[str, list[int]]:
    """Return the modes of each method's episodes; methods whose task has no modes are left out."""
    ways = {name: [e.way for e in played if e.way is not None] for name, played in episodes.items()}
    return {name: told for name, told in ways.items() if told}


def plot_ways(ways: Mapping[str, Sequence[int]], path: str | os.PathLike, *, title: str) -> Path:
    """Draw the shares of episodes in each mode, between modes and without one: a bar per method, with its entropy.

    Args:
        ways: method -> the ways of its episodes, see `EpisodeResult.way`; the first is at the top.
        path: of the PNG.
        title: of the figure.
    """
    known = sorted({way for told in ways.values() for way in told if way >= 0})
    styles = {way: (f"way {way}", _COLORS[way % len(_COLORS)]) for way in known} | _OTHERS
    figure, axes = make_figure(9, 1.4 + 0.36 * len(ways))
    left = dict.fromkeys(ways, 0.0)
    for way, (label, color) in styles.items():
        shares = {name: 100 * list(told).count(way) / len(told) for name, told in ways.items()}
        if any(shares.values()):
            bars = axes.barh([*ways], [*shares.values()], left=[*left.values()], color=color, label=label)
            axes.bar_label(
                bars, labels=_labels(shares.values()), label_type="center", color="white", fontsize=8
            )
        left = {name: left[name] + shares[name] for name in ways}
    for name, told in ways.items():
        entropy = f"{way_entropy(told):.2f} bits" if max(told) >= 0 else ""
        axes.annotate(entropy, (101, name), va="center", fontsize=9, color="#444444")
    axes.set_xlim(0, 114)
    axes.grid(False, axis="y")
    axes.set_xticks(range(0, 101, 20))
    axes.set_xlabel("episodes (%)")
    axes.invert_yaxis()
    axes.set_title(title, loc="left")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return save_figure(figure, path)


def _labels(shares: Iterable[float]) -> list[str]:
    """Return the texts in the bars, none in those that have no room for one."""
    return [f"{share:.0f}" if share >= 4 else "" for share in shares]
