"""How many episodes a verdict will need: rows of a table, a picture, and what a pilot's files say of two methods."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes
from torchrl_sparse.evaluation.statistics.durations import correlation
from torchrl_sparse.evaluation.statistics.power import Plan, Truth, fixed_plan, sequential_plan

__all__ = ["Question", "pilot_truths", "plan_rows", "plot_plan"]

_DRAWN = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9)  # correlations of the picture


@dataclass(frozen=True)
class Question:
    """What the verdict is to show.

    Attributes:
        margin: of the verdict, a difference of rates.
        power: how likely it is to be non-inferior where the assumptions hold.
        analyses: of the sequential designs.
    """

    margin: float
    power: float
    analyses: int

    @cache  # noqa: B019, questions are few
    def fixed(self, truth: Truth, *, paired: bool) -> Plan:
        """See `fixed_plan`."""
        return fixed_plan(truth, self.margin, self.power, paired=paired)

    @cache  # noqa: B019
    def sequential(self, truth: Truth, *, paired: bool) -> Plan:
        """See `sequential_plan`."""
        return sequential_plan(truth, self.margin, self.power, self.analyses, paired=paired)


def plan_rows(truths: Sequence[tuple[str, Truth]], question: Question) -> list[dict[str, str]]:
    """Return a row for each assumption, named or not: column -> text."""
    named = any(name for name, _ in truths)
    rows = []
    for name, truth in truths:
        row = {"method": name} if named else {}
        row |= {"success": f"{truth.success:.3g}", "correlation": f"{truth.correlation:.2g}"}
        if truth.difference:
            row["difference, points"] = f"{100 * truth.difference:+g}"
        for paired, word in ((True, "paired"), (False, "unpaired")):
            asked = truth if paired else replace(truth, correlation=0.0)  # which nothing shares
            row[word] = str(question.fixed(asked, paired=paired).episodes)
            plan = question.sequential(asked, paired=paired)
            row[f"{word}, sequential: expected (cap)"] = f"{plan.expected:.0f} ({plan.episodes})"
        rows.append(row)
    return rows


def pilot_truths(methods: Sequence[MethodOutcomes]) -> list[tuple[str, Truth]]:
    """Return what a pilot says of each method beside the first, under the assumption that both are as good.

    The rate is that of both together, ``(k + 1) / (n + 2)``, so that a pilot without a failure does not promise that none will
    come. The correlation is that of successes on seeds that both ran, and 0 where there are none or it cannot be told.

    Raises:
        InputError: if there are fewer than two methods.
    """
    if len(methods) < 2:
        raise InputError(
            f"files: expected at least two methods, got {', '.join(one.name for one in methods)}"
        )
    base, truths = methods[0], []
    for method in methods[1:]:
        ours, theirs = method.by_start, base.by_start
        shared = [start for start in ours if start in theirs]
        told = None
        if len(shared) > 1:
            told = correlation(*([float(one[start].success) for start in shared] for one in (ours, theirs)))
        n = len(method.outcomes) + len(base.outcomes)
        rate = (method.solved + base.solved + 1) / (n + 2)
        truths.append((method.name, Truth(rate, min(max(told or 0.0, 0.0), 0.999))))
    return truths


def plot_plan(truth: Truth, question: Question, path: str | os.PathLike) -> Path:
    """Draw the episodes of each method over the correlation of successes: fixed and expected, paired and unpaired.

    Args:
        truth: whose rates are drawn; its correlation is marked.
        question: see `Question`.
        path: of the PNG.
    """
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    given = sorted({*_DRAWN, round(truth.correlation, 6)})
    truths = []
    for rho in given:
        try:
            truths.append(Truth(truth.success, rho, truth.difference))
        except InputError:  # rates that differ allow no such correlation
            break
    figure, axes = make_figure(9, 5)
    rhos = np.array([one.correlation for one in truths])
    free = Truth(truth.success, 0.0, truth.difference)
    for paired, color, word in ((False, "#D55E00", "unpaired"), (True, "#0072B2", "paired")):
        asked = truths if paired else [free] * 2
        at = rhos if paired else rhos[[0, -1]]
        fixed = [question.fixed(one, paired=paired).episodes for one in asked]
        expected = [question.sequential(one, paired=paired).expected for one in asked]
        marker = "o" if paired else ""
        axes.plot(at, fixed, color=color, marker=marker, markersize=4, label=f"{word}, fixed")
        label = f"{word}, sequential, expected"
        axes.plot(at, expected, color=color, marker=marker, markersize=4, linestyle="--", label=label)
    axes.axvline(truth.correlation, color="#666666", linewidth=1, linestyle=(0, (2, 3)))
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    low, high = axes.get_ylim()
    ticks = [m * 10**e for e in range(7) for m in (1, 2, 5)]
    axes.set_yticks([tick for tick in ticks if low <= tick <= high])
    axes.set_xlabel("correlation of both methods' successes on a seed")
    axes.set_ylabel("episodes of each method (log scale)")
    axes.set_title(
        f"Margin {100 * question.margin:g} points, power {100 * question.power:g} %, success {truth.success:.3g}",
        loc="left",
    )
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return save_figure(figure, path)
