"""A benchmark's terminal output: six columns, two lines of explanation, and the recommended method."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Literal

from torchrl_sparse.evaluation.results.comparisons import survivors
from torchrl_sparse.evaluation.results.report import comparison_rows, episodes_text, format_table
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry, Results
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import (
    NO_VERDICT,
    NONE_SOLVED,
    count_text,
    difference_text,
    mean_text,
    milliseconds_text,
    ratio_text,
    threads_text,
    verdict_text,
)
from torchrl_sparse.evaluation.statistics.intervals import episodes_needed

__all__ = ["TableStyle", "advice", "print_results", "short_table"]

TableStyle = Literal["short", "full"]

_CHANCE = "dense_noise"  # dense with other noise is no method to use


def print_results(results: Results, style: TableStyle, out: Path) -> None:
    """Print a benchmark's table, short with advice or with all columns, and its output folder."""
    table = format_table(results) if style == "full" else short_table(results)
    print(f"\n{table}\n\nFiles are in {out}")


def short_table(results: Results) -> str:
    """Return six columns, two lines of explanation, and the advice."""
    lasting = survivors(results)
    rows = [_row(name, method, lasting, results) for name, method in results.methods.items()]
    machine, judged = results.machine, results.dense.judged
    notes = (
        f"{results.task}, {episodes_text(results)}; latency of a policy call on {machine.cpu}, "
        f"{threads_text(machine.threads)}. All columns: table=full.",
        "Intervals are of 95 %, verdicts against margins of "
        f"{100 * judged.margin:g} points and {100 * results.dense.time_vs_dense.margin:g} % of the time to success; "
        "† does not survive Holm's correction.",
    )
    pairs = [markdown_table(comparison_rows(results.pairs)), ""] if results.pairs else []
    return "\n".join([markdown_table(rows), "", *notes, "", *pairs, advice(results)])


def _row(name: str, method: MethodEntry, lasting: Collection[str], results: Results) -> dict[str, str]:
    score, baseline = method.score, name == DENSE
    difference = time = ""
    if not baseline:
        nothing = results.dense_did_nothing
        told = NO_VERDICT if nothing else verdict_text(method.judged, f"{name} success" in lasting)
        difference = f"{difference_text(method.judged)}, {told}"
        if not score:
            told = NO_VERDICT if nothing else verdict_text(method.time_vs_dense, f"{name} time" in lasting)
            time = f"{ratio_text(method.time_vs_dense)}, {told}"
    return {
        "method": name,
        "score" if score else "success": mean_text(score.mean, score.ci95)
        if score
        else count_text(method.success),
        "vs dense, points": difference,
        "time vs dense": time,
        "p50, ms": milliseconds_text(method.latency_s.p50),
        "speed-up": f"{method.speedup_vs_dense:.2f}×",
    }


def advice(results: Results) -> str:
    """Recommend the fastest method that is shown to be as good as dense, or say which evidence is missing.

    Shown is what survives Holm's correction: the fastest of many is chosen.
    """
    dense, lasting = results.dense, survivors(results)
    others = {name: entry for name, entry in results.methods.items() if name not in (DENSE, _CHANCE)}
    if results.dense_did_nothing:
        return NONE_SOLVED
    good = [name for name, entry in others.items() if f"{name} success" in lasting and _is_as_good(entry)]
    if good:
        best = max(good, key=lambda name: others[name].speedup_vs_dense)
        points = 100 * others[best].judged.margin
        return f"Use {best}: {others[best].speedup_vs_dense:.1f} times dense's speed, and not worse by {points:g} points."
    played, needed = dense.success.n, episodes_needed(dense.judged.margin)
    if others and played < needed:
        best = max(others, key=lambda name: (others[name].judged.diff, others[name].speedup_vs_dense))
        return (
            f"So far {best}: {others[best].speedup_vs_dense:.1f} times dense's speed, solved {others[best].success.k} of "
            f"{others[best].success.n}. {played} episodes can show no more: {needed} are needed for a verdict."
        )
    return "Use dense: no faster method is shown to be as good. More episodes may show one."


def _is_as_good(entry: MethodEntry) -> bool:
    """Whether it is shown not to lose success, and not shown to take longer."""
    slower = entry.score is None and (
        entry.time_vs_dense.verdict == "inferior" or entry.time_vs_dense.ci95[0] > 1
    )
    faster = entry.speedup_vs_dense > 1
    return entry.judged.verdict == "non-inferior" and faster and not slower
