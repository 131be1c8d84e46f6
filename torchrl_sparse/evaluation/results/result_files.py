"""Rows of text from a file of results, whatever its kind: what a report and a page show of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrl_sparse.evaluation.results.acceleration import acceleration_rows, load_acceleration
from torchrl_sparse.evaluation.results.aggregate import aggregate_rows, load_aggregate, num_verdicts
from torchrl_sparse.evaluation.results.choices import budget_rows, headline_rows
from torchrl_sparse.evaluation.results.comparisons import num_comparisons
from torchrl_sparse.evaluation.results.engine_report import (
    COLUMNS,
    engine_rows,
    image_part_rows,
    load_engine_results,
)
from torchrl_sparse.evaluation.results.query_report import load_query_profile, query_rows
from torchrl_sparse.evaluation.results.realtime import load_realtime, num_late_comparisons, realtime_rows
from torchrl_sparse.evaluation.results.report import comparison_rows, results_rows
from torchrl_sparse.evaluation.results.schema import Results, load_results
from torchrl_sparse.evaluation.results.text import count_text, mean_text, percent_text
from torchrl_sparse.evaluation.results.vla_report import (
    load_vla_results,
    vla_method_rows,
    vla_part_rows,
    vla_product_rows,
)

__all__ = ["READERS", "Row", "Table", "make_table", "read_tables"]

Row = Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """One table of a file.

    Attributes:
        task: that it is about.
        columns: that it shows unless others are asked for; the first names a row.
        rows: column -> text; of these and of further columns.
        comparisons: verdicts among all its rows that † was decided for; 0 where a table marks none.
    """

    task: str
    columns: tuple[str, ...]
    rows: Sequence[Row]
    comparisons: int = 0

    def name(self, row: Row) -> str:
        """Return what a row is about: a method, a variant, a part."""
        return row[self.columns[0]]


def read_tables(
    path: Path, readers: Mapping[str, Callable[[Path], dict[str, Table]]] | None = None
) -> dict[str, Table]:
    """Read all tables of a file of results that its episodes are not needed for, by name.

    Args:
        path: of a file whose name begins with a key of ``readers``.
        readers: beginning of a name -> reader; `READERS` without it.
    """
    found = READERS if readers is None else readers
    return next(read for kind, read in found.items() if path.name.startswith(kind))(path)


def _results(path: Path) -> dict[str, Table]:
    results = load_results(path)
    rows = results_rows(results)
    whole = [{**row, **_more(results, row["method"])} for row in rows]
    methods = replace(make_table(results.subject, whole, len(rows[0])), comparisons=num_comparisons(results))
    pairs = results.pairs
    compared = {"pairs": make_table(results.subject, comparison_rows(pairs))} if pairs else {}
    headline, budgets = headline_rows(results), budget_rows(results)
    chosen = {
        "headline": make_table(results.subject, headline),
        "budgets": make_table(results.subject, budgets),
    }
    return {"methods": methods} | compared | chosen


def _more(results: Results, name: str) -> Row:
    """Return the columns that only a page asks for."""
    method = results.methods[name]
    chunks, score = 1 / method.latency_s.p50, method.score
    limits, within = method.speedup_ci95, method.success_within
    early = "" if results.early_cut is None else f"{100 * within[str(results.early_cut)]:.1f}"
    return {
        "success, %": percent_text(method.success),
        "success or score": mean_text(score.mean, score.ci95) if score else count_text(method.success),
        "action chunks per second": f"{chunks:.1f}",
        "actions per second": f"{results.policy.n_action_steps * chunks:.0f}",
        "mean time, steps": f"{method.restricted_mean_time:.1f}",
        "early, %": early,
        "speed-up, 95 %": "" if limits is None else f"[{limits[0]:.2f}, {limits[1]:.2f}]",
        # Beside rows that success and time decide, one that its score decides has no times.
        **(dict.fromkeys(("time vs dense", "time verdict"), "") if score else {}),
    }


def _realtime(path: Path) -> dict[str, Table]:
    results = load_realtime(path)
    table = make_table(results.task, realtime_rows(results))
    return {"methods": replace(table, comparisons=num_late_comparisons(results))}


def _engine(path: Path) -> dict[str, Table]:
    shapes = load_engine_results(path).shapes
    tables = {name: make_table(name, engine_rows(shape), len(COLUMNS)) for name, shape in shapes.items()}
    images = {name: shape.image_parts_s for name, shape in shapes.items() if shape.image_parts_s}
    return tables | {
        f"{name}_parts": make_table(name, image_part_rows(parts)) for name, parts in images.items()
    }


def _query(path: Path) -> dict[str, Table]:
    found = load_query_profile(path)
    return {name: make_table(found.sampler, rows) for name, rows in query_rows(found).items()}


def _vla(path: Path) -> dict[str, Table]:
    results = load_vla_results(path)
    rows = {"methods": vla_method_rows(results), "parts": vla_part_rows(results)}
    rows["products"] = vla_product_rows(results)
    return {name: make_table(results.shape.name, of_one) for name, of_one in rows.items() if of_one}


def _aggregate(path: Path) -> dict[str, Table]:
    results = load_aggregate(path)
    table = make_table(", ".join(results.tasks), aggregate_rows(results))
    return {"methods": replace(table, comparisons=num_verdicts(results))}


def _acceleration(path: Path) -> dict[str, Table]:
    found = load_acceleration(path)
    rows = acceleration_rows(found)
    played = [row for row in rows if row["method"].removesuffix(" (chosen)") in found.played]
    tables = {"candidates": make_table(found.task, rows)}
    return tables | ({"played": make_table(found.task, played)} if played else {})


def make_table(task: str, rows: Sequence[Row], shown: int | None = None) -> Table:
    """Make a table that shows its first columns, all unless it is said how many."""
    return Table(task, tuple(rows[0])[:shown], rows)


READERS = {
    "results": _results,
    "acceleration": _acceleration,
    "aggregate": _aggregate,
    "realtime": _realtime,
    "engine": _engine,
    "query": _query,
    "vla_latency": _vla,
}
"""What the name of a file begins with -> reader of its tables."""
