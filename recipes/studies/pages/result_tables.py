"""Tables of the files that a benchmark writes, with every column that a page can show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from recipes.studies.pages.choices import budget_rows, headline_rows
from torchrl_sparse.evaluation.results.acceleration import acceleration_rows, load_acceleration
from torchrl_sparse.evaluation.results.comparisons import num_comparisons
from torchrl_sparse.evaluation.results.realtime import load_realtime, num_late_comparisons, realtime_rows
from torchrl_sparse.evaluation.results.report import comparison_rows, results_rows
from torchrl_sparse.evaluation.results.result_files import Row, Table, make_table
from torchrl_sparse.evaluation.results.schema import Results, load_results
from torchrl_sparse.evaluation.results.text import count_text, mean_text, percent_range

__all__ = ["acceleration_tables", "realtime_tables", "results_tables", "subject"]


def subject(results: Results) -> str:
    """Return the heading that tells results apart: the task, and whether the policy has cameras for it."""
    return f"{results.task}, cameras" if results.policy.cameras else results.task


def results_tables(path: Path) -> dict[str, Table]:
    """Return the tables of a ``results.json``: its methods, its pairs, and the recommendations."""
    results = load_results(path)
    rows = results_rows(results)
    whole = [{**row, **_more(results, row["method"])} for row in rows]
    methods = replace(make_table(subject(results), whole, len(rows[0])), comparisons=num_comparisons(results))
    pairs = results.pairs
    compared = {"pairs": make_table(subject(results), comparison_rows(pairs))} if pairs else {}
    headline, budgets = headline_rows(results), budget_rows(results)
    chosen = {
        "headline": make_table(subject(results), headline),
        "budgets": make_table(subject(results), budgets),
    }
    return {"methods": methods} | compared | chosen


def _more(results: Results, name: str) -> Row:
    """Return the columns that only a page asks for."""
    method = results.methods[name]
    chunks, score = 1 / method.latency_s.p50, method.score
    limits, within = method.speedup_ci95, method.success_within
    early = "" if results.early_cut is None else f"{100 * within[str(results.early_cut)]:.1f}"
    return {
        "success, %": f"{100 * method.success.rate:.1f} {percent_range(method.success.ci95)}",
        "success or score": mean_text(score.mean, score.ci95) if score else count_text(method.success),
        "action chunks per second": f"{chunks:.1f}",
        "actions per second": f"{results.policy.n_action_steps * chunks:.0f}",
        "mean time, steps": f"{method.restricted_mean_time:.1f}",
        "early, %": early,
        "speed-up, 95 %": "" if limits is None else f"[{limits[0]:.2f}, {limits[1]:.2f}]",
        # Beside rows that success and time decide, one that its score decides has no times.
        **(dict.fromkeys(("time vs dense", "time verdict"), "") if score else {}),
    }


def realtime_tables(path: Path) -> dict[str, Table]:
    """Return the table of a ``realtime.json``."""
    results = load_realtime(path)
    table = make_table(results.task, realtime_rows(results))
    return {"methods": replace(table, comparisons=num_late_comparisons(results))}


def acceleration_tables(path: Path) -> dict[str, Table]:
    """Return the tables of an ``acceleration.json``: its candidates, and the methods that were played."""
    found = load_acceleration(path)
    rows = acceleration_rows(found)
    played = [row for row in rows if row["method"].removesuffix(" (chosen)") in found.played]
    tables = {"candidates": make_table(found.task, rows)}
    return tables | ({"played": make_table(found.task, played)} if played else {})
