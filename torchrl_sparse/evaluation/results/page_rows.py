"""Rows of text from any file of results, with every column that a page may ask for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.evaluation.results.engine_report import COLUMNS, engine_rows, load_engine_results
from torchrl_sparse.evaluation.results.realtime import load_realtime, realtime_rows
from torchrl_sparse.evaluation.results.report import pair_rows, results_rows
from torchrl_sparse.evaluation.results.schema import Results, load_results
from torchrl_sparse.evaluation.results.text import percent_text
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
    rows = [{**row, **_more(results, row["method"])} for row in results_rows(results)]
    return {"methods": _table(results.task, rows, len(rows[0]) - len(_MORE))}


_MORE = "success, %", "action chunks per second", "actions per second"


def _more(results: Results, name: str) -> Row:
    method = results.methods[name]
    chunks = 1 / method.latency_s.p50
    texts = percent_text(method.success), f"{chunks:.1f}", f"{results.policy.n_action_steps * chunks:.0f}"
    return dict(zip(_MORE, texts, strict=True))


def _realtime(path: Path) -> dict[str, Table]:
    results = load_realtime(path)
    return {"methods": _table(results.task, realtime_rows(results))}


def _engine(path: Path) -> dict[str, Table]:
    shapes = load_engine_results(path).shapes
    return {name: _table(name, engine_rows(shape), len(COLUMNS)) for name, shape in shapes.items()}


def _vla(path: Path) -> dict[str, Table]:
    results = load_vla_results(path)
    rows = {"methods": vla_method_rows(results), "parts": vla_part_rows(results)}
    return {name: _table(results.shape.name, of_one) for name, of_one in rows.items()}


def _pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> Table:
    results = load_results(path)
    seeds = evaluation_seeds(results.seed, results.dense.success.n)
    names = {name for pair in pairs for name in pair}
    episodes = {name: list(_episodes(path.parent / "episodes" / f"{name}.jsonl", seeds)) for name in names}
    return _table(results.task, pair_rows(episodes, pairs, results.dense.paired_vs_dense.margin))


def _table(task: str, rows: Sequence[Row], shown: int | None = None) -> Table:
    """Make a table that shows its first columns, all unless it is said how many."""
    return Table(task, tuple(rows[0])[:shown], rows)


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
