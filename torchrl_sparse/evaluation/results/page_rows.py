"""Rows of text from any file of results, with every column that a page may ask for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchrl_sparse.evaluation.results.acceleration import acceleration_rows, load_acceleration
from torchrl_sparse.evaluation.results.aggregate import aggregate_rows, load_aggregate, num_verdicts
from torchrl_sparse.evaluation.results.carried_noise import carried_noise_rows, load_carried_noise
from torchrl_sparse.evaluation.results.choices import budget_rows, headline_rows
from torchrl_sparse.evaluation.results.comparisons import num_comparisons
from torchrl_sparse.evaluation.results.completed import completed_rows, told_completed
from torchrl_sparse.evaluation.results.engine_report import (
    COLUMNS,
    engine_rows,
    image_part_rows,
    load_engine_results,
)
from torchrl_sparse.evaluation.results.late_pairs import late_pair_rows
from torchrl_sparse.evaluation.results.offline import agreement_rows, error_rows, load_offline
from torchrl_sparse.evaluation.results.offline_agreement import load_agreement, together_rows
from torchrl_sparse.evaluation.results.query_report import load_query_profile, query_rows
from torchrl_sparse.evaluation.results.realtime import load_realtime, num_late_comparisons, realtime_rows
from torchrl_sparse.evaluation.results.report import comparison_rows, pair_rows, results_rows
from torchrl_sparse.evaluation.results.schema import AnyResults, MethodEntry, Results, load_results
from torchrl_sparse.evaluation.results.scores import score_rows, told_scores
from torchrl_sparse.evaluation.results.stopping import load_stopping, stopping_rows
from torchrl_sparse.evaluation.results.text import count_text, mean_text, percent_text
from torchrl_sparse.evaluation.results.vla_report import (
    load_vla_results,
    vla_method_rows,
    vla_part_rows,
    vla_product_rows,
)
from torchrl_sparse.evaluation.results.ways import told_ways, way_rows
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes

__all__ = ["KINDS", "Row", "Table", "read_table", "read_tables"]

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


def read_table(path: Path, which: str | None = None, pairs: Sequence[tuple[str, str]] = ()) -> Table:
    """Read a file of results, whose kind its name begins with.

    Args:
        path: ``results*.json``, ``acceleration*.json``, ``aggregate*.json``, ``realtime*.json``, ``engine*.json``,
            ``query*.json``, ``vla_latency*.json``, ``offline_agreement*.json``, ``offline_errors*.json``,
            ``carried_noise*.json`` or ``stopping*.json``.
        which: of the tables of the file, where it has several.
        pairs: of methods to compare, from the episodes beside a ``results*.json`` or those of a ``realtime*.json``, instead of
            its rows.

    Raises:
        FileNotFoundError: if the file is not there.
        ValueError: if its name is of no kind, the file is of no use, or it has no such table.
    """
    if not path.name.startswith(KINDS):
        names = ", ".join(f"{kind}*.json" for kind in KINDS)
        raise ValueError(f"expected a file {names}, got {path.name}")
    if pairs:
        return _pairs(path, pairs)
    if which in _OF_EPISODES:
        return _told(path, which)
    tables = read_tables(path)
    name = which or next(iter(tables))
    if name not in tables:
        raise ValueError(f"rows: expected one of {', '.join(tables)}, got {name!r}")
    return tables[name]


def read_tables(path: Path) -> dict[str, Table]:
    """Read all tables of such a file that its episodes are not needed for, by name."""
    return next(read for kind, read in _READERS.items() if path.name.startswith(kind))(path)


def _results(path: Path) -> dict[str, Table]:
    results = load_results(path)
    rows = results_rows(results)
    whole = [{**row, **_more(results, row["method"])} for row in rows]
    marked = num_comparisons(results) if isinstance(results, Results) else 0
    methods = replace(_table(results.subject, whole, len(rows[0])), comparisons=marked)
    pairs = results.pairs if isinstance(results, Results) else None
    compared = {"pairs": _table(results.subject, comparison_rows(pairs))} if pairs else {}
    if not isinstance(results, Results) or results.dense.restricted_mean_time is None:
        return {"methods": methods} | compared
    headline, budgets = headline_rows(results), budget_rows(results)
    chosen = {"headline": _table(results.subject, headline), "budgets": _table(results.subject, budgets)}
    return {"methods": methods} | compared | chosen


def _more(results: AnyResults, name: str) -> Row:
    """Return the columns that only a page asks for."""
    method = results.methods[name]
    chunks, score = 1 / method.latency_s.p50, method.score
    more = {
        "success, %": percent_text(method.success),
        "success or score": mean_text(score.mean, score.ci95) if score else count_text(method.success),
        "action chunks per second": f"{chunks:.1f}",
        "actions per second": f"{results.policy.n_action_steps * chunks:.0f}",
    }
    if isinstance(method, MethodEntry):
        more |= _more_of_times(results, method)
        if not score:
            return more
    # Beside rows of version 2 that success and time decide, one of version 1 or one that its score decides has no times.
    return more | dict.fromkeys(("time vs dense", "time verdict"), "")


def _more_of_times(results: Results, method: MethodEntry) -> Row:
    """Return those of version 2, empty where a method's episodes are not kept."""
    mean, shares, limits = method.restricted_mean_time, method.success_within, method.speedup_ci95
    early = None if shares is None or results.early_cut is None else shares[str(results.early_cut)]
    return {
        "mean time, steps": "" if mean is None else f"{mean:.1f}",
        "early, %": "" if early is None else f"{100 * early:.1f}",
        "speed-up, 95 %": "" if limits is None else f"[{limits[0]:.2f}, {limits[1]:.2f}]",
    }


def _realtime(path: Path) -> dict[str, Table]:
    results = load_realtime(path)
    table = _table(results.task, realtime_rows(results))
    return {"methods": replace(table, comparisons=num_late_comparisons(results))}


def _engine(path: Path) -> dict[str, Table]:
    shapes = load_engine_results(path).shapes
    tables = {name: _table(name, engine_rows(shape), len(COLUMNS)) for name, shape in shapes.items()}
    images = {name: shape.image_parts_s for name, shape in shapes.items() if shape.image_parts_s}
    return tables | {f"{name}_parts": _table(name, image_part_rows(parts)) for name, parts in images.items()}


def _query(path: Path) -> dict[str, Table]:
    found = load_query_profile(path)
    return {name: _table(found.sampler, rows) for name, rows in query_rows(found).items()}


def _vla(path: Path) -> dict[str, Table]:
    results = load_vla_results(path)
    rows = {"methods": vla_method_rows(results), "parts": vla_part_rows(results)}
    rows["products"] = vla_product_rows(results)
    return {name: _table(results.shape.name, of_one) for name, of_one in rows.items() if of_one}


def _pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> Table:
    if path.name.startswith("realtime"):
        return _table(load_realtime(path).task, late_pair_rows(path, pairs))
    results = load_results(path)
    episodes = _episodes(path, results, {name for pair in pairs for name in pair})
    return _table(results.subject, pair_rows(episodes, pairs, results.dense.paired_vs_dense.margin))


def _told(path: Path, which: str) -> Table:
    tell, rows, expected = _OF_EPISODES[which]
    results = load_results(path)
    told = tell(_episodes(path, results, results.methods))
    if not told:
        raise ValueError(f"rows: expected episodes of {results.task} {expected}, got none")
    return _table(results.subject, rows(told, results))


def _episodes(path: Path, results: AnyResults, names: Iterable[str]) -> dict[str, list[EpisodeResult]]:
    """Read the episodes of methods that are of these results, of each as many as they say; a log may have more."""
    found = {}
    for name in names:
        seeds = range(results.first_seed, results.first_seed + results.methods[name].success.n)
        log = read_episodes(path.parent / "episodes" / f"{name}.jsonl")
        found[name] = [episode for episode in log if episode.seed in seeds]
    return found


def _table(task: str, rows: Sequence[Row], shown: int | None = None) -> Table:
    """Make a table that shows its first columns, all unless it is said how many."""
    return Table(task, tuple(rows[0])[:shown], rows)


def _aggregate(path: Path) -> dict[str, Table]:
    results = load_aggregate(path)
    table = _table(", ".join(results.tasks), aggregate_rows(results))
    return {"methods": replace(table, comparisons=num_verdicts(results))}


def _acceleration(path: Path) -> dict[str, Table]:
    found = load_acceleration(path)
    rows = acceleration_rows(found)
    played = [row for row in rows if row["method"].removesuffix(" (chosen)") in found.played]
    tables = {"candidates": _table(found.task, rows)}
    return tables | ({"played": _table(found.task, played)} if played else {})


def _agreement(path: Path) -> dict[str, Table]:
    agreement = load_agreement(path)
    return {
        name: _table(", ".join(agreement.methods), rows) for name, rows in together_rows(agreement).items()
    }


def _offline(path: Path) -> dict[str, Table]:
    results = load_offline(path)
    rows = {"methods": error_rows(results), "agreement": agreement_rows(results)}
    return {name: _table(results.task, of_one) for name, of_one in rows.items()}


def _carried_noise(path: Path) -> dict[str, Table]:
    results = load_carried_noise(path)
    return {"samplers": _table(results.task, carried_noise_rows(results))}


def _stopping(path: Path) -> dict[str, Table]:
    results = load_stopping(path)
    return {name: _table(f"{results.trials} trials", rows) for name, rows in stopping_rows(results).items()}


_OF_EPISODES: dict[str, tuple[Callable, Callable, str]] = {
    "completed": (told_completed, lambda told, _: completed_rows(told), "that count its parts"),
    "ways": (told_ways, lambda told, _: way_rows(told), "that tell their ways"),
    "scores": (
        told_scores,
        lambda told, results: score_rows(told, results.dense.paired_vs_dense.margin),
        "with scores",
    ),
}
_READERS = {
    "results": _results,
    "acceleration": _acceleration,
    "aggregate": _aggregate,
    "realtime": _realtime,
    "engine": _engine,
    "query": _query,
    "vla_latency": _vla,
    "offline_agreement": _agreement,
    "offline_errors": _offline,
    "carried_noise": _carried_noise,
    "stopping": _stopping,
}
KINDS = tuple(_READERS)
"""What the name of a file of results begins with."""
