"""Verdicts as a table, lines of text, a picture and an HTML page."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes
from torchrl_sparse.evaluation.compare.verdicts import Comparison, Verdicts
from torchrl_sparse.evaluation.figures.html_report import Medium, Run, write_page
from torchrl_sparse.evaluation.results.parts import Success
from torchrl_sparse.evaluation.results.text import (
    count_text,
    difference_text,
    p_text,
    ratio_text,
    verdict_text,
)

__all__ = ["plot_verdicts", "verdict_notes", "verdict_rows", "write_verdicts"]

_COLORS = {"non-inferior": "#009E73", "inferior": "#D55E00", "inconclusive": "#777777"}


def verdict_rows(verdicts: Verdicts) -> list[dict[str, str]]:
    """Return the rows of the table, the reference first: column -> text; † as in every table of results."""
    reference, timed = verdicts.reference, any(one.time for one in verdicts.comparisons)
    found = {method.name: method for method in verdicts.methods}
    rows = [_row(reference, None, verdicts, timed)]
    return rows + [_row(found[one.method], one, verdicts, timed) for one in verdicts.comparisons]


def _row(method: MethodOutcomes, one: Comparison | None, verdicts: Verdicts, timed: bool) -> dict[str, str]:
    against = verdicts.reference.name
    row = {
        "method": method.name,
        "success": count_text(Success.of([outcome.success for outcome in method.outcomes])),
        f"vs {against}, points": difference_text(one.success) if one else "",
        "verdict": verdict_text(one.success, f"{method.name} success" in verdicts.lasting) if one else "",
        "p of no difference": p_text(one.p_equal) if one else "",
        "design": _design(one) if one else "reference",
    }
    if timed:
        told, last = one.time if one else None, f"{method.name} time" in verdicts.lasting
        row[f"time vs {against}"] = ratio_text(told) if told else ""
        row["time verdict"] = verdict_text(told, last) if told else ""
    return row


def _design(one: Comparison) -> str:
    counts = one.counts
    alone = f"{counts.ours[1]} and {counts.theirs[1]} alone"
    if one.design == "partly paired":
        return f"partly paired: {counts.pairs} pairs, {alone}"
    return f"paired: {counts.pairs} pairs" if one.design == "paired" else f"unpaired: {alone}"


def verdict_notes(verdicts: Verdicts) -> list[str]:
    """Return what has to be said below the table: by which tests, what pairs rest on, and who may be the best."""
    designs = {one.design for one in verdicts.comparisons}
    margin = verdicts.comparisons[0].success.margin
    notes = [
        f"Verdicts: 95 % intervals against a margin of {100 * margin:g} points. † does not survive Holm's correction for "
        f"{verdicts.num_verdicts} verdicts."
    ]
    notes += [text for design, text in _DESIGNS.items() if design in designs]
    starts = {o.start.kind if o.start else "" for method in verdicts.methods for o in method.outcomes}
    if "index" in starts and designs & {"paired", "partly paired"}:
        notes.append(
            "Some files name no seeds: episodes of the same number count as pairs, which holds if runs began alike."
        )
    if "index" in starts and "seed" in starts:
        notes.append("Files with seeds and files without have no pair in common.")
    if "" in starts:
        notes.append("Some files tell counts alone, whose episodes are nobody's pair.")
    if failed := sum(bool(o.error) for method in verdicts.methods for o in method.outcomes):
        notes.append(f"{failed} episodes that ended in an error count as failures.")
    if any(method.stopped for method in verdicts.methods):
        notes.append(
            "Some methods stopped where their verdict was reached; here their numbers count as fixed, which makes intervals "
            "too short. The table of their own benchmark is the one that holds."
        )
    if verdicts.best:
        num = len(verdicts.methods) * (len(verdicts.methods) - 1) // 2
        notes.append(
            f"Cannot be told from the best: {', '.join(verdicts.best)} (all {num} pairs compared, Holm's correction, 5 %)."
        )
    return notes


_DESIGNS = {
    "paired": "Paired: Tango's interval, McNemar's exact p.",
    "partly paired": "Partly paired: a score interval of pairs and of episodes that one method alone ran, its p.",
    "unpaired": "Unpaired, no seed in common: Miettinen and Nurminen's interval, its p.",
}


def plot_verdicts(verdicts: Verdicts, path: str | os.PathLike) -> Path:
    """Draw the differences with their intervals and the margin.

    Args:
        verdicts: see `compare_methods`.
        path: of the PNG.
    """
    names = [one.method for one in verdicts.comparisons]
    figure, axes = make_figure(9, 1.7 + 0.38 * len(names))
    for row, one in enumerate(verdicts.comparisons):
        low, high = (100 * limit for limit in one.success.ci95)
        color, middle = _COLORS[one.success.verdict], 100 * one.success.diff
        axes.plot([low, high], [row, row], color=color, linewidth=2.2, solid_capstyle="butt")
        axes.plot([middle], [row], "o", color=color, markersize=6)
    margin = 100 * verdicts.comparisons[0].success.margin
    axes.axvline(0, color="#222222", linewidth=1)
    axes.axvline(-margin, color="#666666", linewidth=1, linestyle=(0, (4, 3)))
    axes.annotate(
        f" margin, {-margin:g} points",
        (-margin, 1.0),
        xycoords=("data", "axes fraction"),
        va="bottom",
        fontsize=9,
        color="#666666",
    )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(f"success minus that of {verdicts.reference.name}, points, with 95 % interval")
    for verdict, color in _COLORS.items():
        axes.plot([], [], "o-", color=color, label=verdict)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return save_figure(figure, path)


def write_verdicts(
    verdicts: Verdicts, sources: Sequence[str], path: str | os.PathLike, *, title: str
) -> Path:
    """Write the table, the notes and the picture as one HTML page that needs nothing else.

    Args:
        verdicts: see `compare_methods`.
        sources: the files, for the head of the section.
        path: of the HTML file.
        title: of the page.
    """
    with tempfile.TemporaryDirectory() as folder:
        drawn = Medium.read(plot_verdicts(verdicts, Path(folder) / "figure.png"), "differences and verdicts")
    rows, notes = verdict_rows(verdicts), " ".join(verdict_notes(verdicts))
    return write_page([Run(", ".join(sources), {"": rows}, notes, [drawn])], path, title=title)
