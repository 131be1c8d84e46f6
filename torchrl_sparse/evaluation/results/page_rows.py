"""Rows of text from any file of results, with every column that a page may ask for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.evaluation.results.engine_report import engine_rows, load_engine_results
from torchrl_sparse.evaluation.results.realtime import load_realtime, realtime_rows
from torchrl_sparse.evaluation.results.report import format_percent, load_results, pair_rows, results_rows
from torchrl_sparse.evaluation.results.vla_report import load_vla_results, vla_method_rows, vla_part_rows
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.storage.json import parse_json

__all__ = ["Row", "Table", "read_table"]

Row = Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """One table of a file.

    Attributes:
        task: that it is about.
        columns: that it shows unless others are asked for; the first names a row.
        rows: column -> text; of these and of further columns.
    """

    task: str
    columns: tuple[str, ...]
    rows: Sequence[Row]

    def name(self, row: Row) -> str:
        """Return what a row is about: a method, a variant, a part."""
        return row[self.columns[0]]


def read_table(path: Path, which: str | None = None, pairs: Sequence[tuple[str, str]] = ()) -> Table:
    """Read a file of results, whose kind its name begins with.

    Args:
        path: ``results*.json``, ``realtime*.json``, ``engine*.json`` or ``vla_latency*.json``.
        which: of the tables of the file, where it has several.
        pairs: of methods to compare, from the episodes beside a ``results*.json``, instead of its rows.

    Raises:
        FileNotFoundError: if the file is not there.
        ValueError: if its name is of no kind, the file is of no use, or it has no such table.
    """
    kind = next((kind for kind in _READERS if path.name.startswith(kind)), None)
    if kind is None:
        names = ", ".join(f"{kind}*.json" for kind in _READERS)
        raise ValueError(f"expected a file {names}, got {path.name}")
    if pairs:
        return _pairs(path, pairs)
    tables = _READERS[kind](path)
    name = which or next(iter(tables))
    if name not in tables:
        raise ValueError(f"rows: expected one of {', '.join(tables)}, got {name!r}")
    return tables[name]


def _results(path: Path) -> dict[str, Table]:
    results = load_results(path)
    rows = results_rows(results)
    more = [_more(results, row["method"]) for row in rows]
    wide = [{"task": results["task"], **row, **extra} for row, extra in zip(rows, more, strict=True)]
    return {"methods": Table(results["task"], tuple(rows[0]), wide)}


def _more(results: Mapping[str, Any], name: str) -> Row:
    method, executed = results["methods"][name], results["policy"]["n_action_steps"]
    chunks = 1 / method["latency_s"]["p50"]
    return {
        "success, %": format_percent(**method["success"]),
        "action chunks per second": f"{chunks:.1f}",
        "actions per second": f"{executed * chunks:.0f}",
    }


def _realtime(path: Path) -> dict[str, Table]:
    results = load_realtime(path)
    rows = realtime_rows(results)
    return {"methods": Table(results["task"], tuple(rows[0]), [{"task": results["task"], **r} for r in rows])}


def _engine(path: Path) -> dict[str, Table]:
    tables = {}
    for name, shape in load_engine_results(path)["shapes"].items():
        rows = engine_rows(shape)
        tables[name] = Table(name, tuple(rows[0])[:-2], rows)
    return tables


def _vla(path: Path) -> dict[str, Table]:
    results = load_vla_results(path)
    tables = {"methods": vla_method_rows(results), "parts": vla_part_rows(results)}
    return {name: Table(results["shape"]["name"], tuple(rows[0]), rows) for name, rows in tables.items()}


def _pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> Table:
    results = load_results(path)
    dense = next(iter(results["methods"].values()))
    seeds = evaluation_seeds(results["seed"], dense["success"]["n"])
    names = {name for pair in pairs for name in pair}
    episodes = {name: list(_episodes(path.parent / "episodes" / f"{name}.jsonl", seeds)) for name in names}
    rows = pair_rows(episodes, pairs, dense["paired_vs_dense"]["margin"])
    return Table(results["task"], tuple(rows[0]), [{"task": results["task"], **row} for row in rows])


def _episodes(path: Path, seeds: range) -> Iterator[EpisodeResult]:
    """Read the episodes of these seeds from a log, which stays as it is."""
    if not path.is_file():
        raise FileNotFoundError(f"expected a log of episodes {path}, got none")
    with path.open(encoding="utf-8") as lines:
        next(lines)
        for number, line in enumerate(lines, start=2):
            episode = parse_json(line, EpisodeResult, f"{path}:{number}")
            if episode.seed in seeds:
                yield episode


_READERS = {"results": _results, "realtime": _realtime, "engine": _engine, "vla_latency": _vla}
