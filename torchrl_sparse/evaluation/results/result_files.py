"""Tables, as text, of results files that have no figures, for the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrl_sparse.evaluation.results.aggregate import aggregate_rows, load_aggregate, num_verdicts
from torchrl_sparse.evaluation.results.engine_report import (
    COLUMNS,
    engine_rows,
    image_part_rows,
    load_engine_results,
)
from torchrl_sparse.evaluation.results.query_report import load_query_profile, query_rows
from torchrl_sparse.evaluation.results.vla_report import (
    load_vla_results,
    vla_method_rows,
    vla_part_rows,
    vla_product_rows,
)
from torchrl_sparse.evaluation.results.world_report import load_world_profile, world_rows

__all__ = ["READERS", "Row", "Table", "make_table", "read_tables"]

Row = Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """One table of a results file.

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
        """Return the subject of a row: a method, a variant, a part."""
        return row[self.columns[0]]


def read_tables(path: Path) -> dict[str, Table]:
    """Read all tables, by name, of a file whose name begins with a key of `READERS`."""
    return next(read for kind, read in READERS.items() if path.name.startswith(kind))(path)


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


def _world(path: Path) -> dict[str, Table]:
    return {"world": make_table("robosuite", world_rows(load_world_profile(path)))}


def _aggregate(path: Path) -> dict[str, Table]:
    results = load_aggregate(path)
    table = make_table(", ".join(results.tasks), aggregate_rows(results))
    return {"methods": replace(table, comparisons=num_verdicts(results))}


def make_table(task: str, rows: Sequence[Row], shown: int | None = None) -> Table:
    """Make a table that shows its first columns; all by default."""
    return Table(task, tuple(rows[0])[:shown], rows)


READERS = {
    "aggregate": _aggregate,
    "engine": _engine,
    "query": _query,
    "vla_latency": _vla,
    "world": _world,
}
"""What the name of a file begins with -> reader of its tables."""
