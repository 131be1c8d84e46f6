"""Rows of text from any results file, including the studies', with every column that a page can show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from recipes.studies.carried_noise.results import carried_noise_rows, load_carried_noise
from recipes.studies.offline_errors.agreement import load_agreement, together_rows
from recipes.studies.offline_errors.results import agreement_rows, error_rows, load_offline
from recipes.studies.pages.completed import completed_rows, told_completed
from recipes.studies.pages.delayed_pairs import late_pair_rows
from recipes.studies.pages.result_tables import acceleration_tables, realtime_tables, results_tables, subject
from recipes.studies.pages.scores import score_rows, told_scores
from recipes.studies.pages.ways import way_rows
from recipes.studies.simulate_stopping.results import load_stopping, stopping_rows
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.figures.ways import count_modes
from torchrl_sparse.evaluation.results.build import Terms, compare_pair
from torchrl_sparse.evaluation.results.realtime import load_realtime
from torchrl_sparse.evaluation.results.report import comparison_rows
from torchrl_sparse.evaluation.results.result_files import READERS, Table, make_table
from torchrl_sparse.evaluation.results.schema import Results, load_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes
from torchrl_sparse.evaluation.statistics.sequential import Design

__all__ = ["read_table"]


def read_table(path: Path, which: str | None = None, pairs: Sequence[tuple[str, str]] = ()) -> Table:
    """Read a results file; the start of its name says its kind.

    Args:
        path: ``results*.json``, ``acceleration*.json``, ``aggregate*.json``, ``realtime*.json``, ``engine*.json``,
            ``query*.json``, ``vla_latency*.json``, ``offline_agreement*.json``, ``offline_errors*.json``,
            ``carried_noise*.json`` or ``stopping*.json``.
        which: of the tables of the file, where it has several.
        pairs: of methods to compare, from the episodes beside a ``results*.json`` or those of a ``realtime*.json``, instead of
            its rows.

    Raises:
        FileNotFoundError: if the file is not there.
        InputError: if its name is of no kind, the file is of no use, or it has no such table.
    """
    if not path.name.startswith((*_READERS,)):
        names = ", ".join(f"{kind}*.json" for kind in _READERS)
        raise InputError(f"expected a file {names}, got {path.name}")
    if pairs:
        return _pairs(path, pairs)
    if which in _OF_EPISODES:
        return _told(path, which)
    tables = next(read for kind, read in _READERS.items() if path.name.startswith(kind))(path)
    name = which or next(iter(tables))
    if name not in tables:
        raise InputError(f"rows: expected one of {', '.join(tables)}, got {name!r}")
    return tables[name]


def _pairs(path: Path, pairs: Sequence[tuple[str, str]]) -> Table:
    if path.name.startswith("realtime"):
        return make_table(load_realtime(path).task, late_pair_rows(path, pairs))
    results = load_results(path)
    names = {name for pair in pairs for name in pair}
    if unknown := sorted(names - results.methods.keys()):
        raise InputError(f"pairs: expected two of {', '.join(results.methods)}, got {', '.join(unknown)}")
    played = _episodes(path, results, names)
    terms = Terms(
        Design(results.dense.success.n),
        results.episode_horizon,
        margin=results.dense.paired_vs_dense.margin,
        time_margin=results.dense.time_vs_dense.margin,
    )
    compared = [compare_pair(ours, played[ours], other, played[other], terms) for ours, other in pairs]
    return make_table(subject(results), comparison_rows(compared), len(_OF_PAIRS))


def _told(path: Path, which: str) -> Table:
    tell, rows, expected = _OF_EPISODES[which]
    results = load_results(path)
    told = tell(_episodes(path, results, results.methods))
    if not told:
        raise InputError(f"rows: expected episodes of {results.task} {expected}, got none")
    return make_table(subject(results), rows(told, results))


def _episodes(path: Path, results: Results, names: Iterable[str]) -> dict[str, list[EpisodeResult]]:
    """Read the episodes of methods that are of these results, of each as many as they say; a log may have more."""
    found = {}
    for name in names:
        seeds = range(results.first_seed, results.first_seed + results.methods[name].success.n)
        log = read_episodes(path.parent / "episodes" / f"{name}.jsonl")
        found[name] = [episode for episode in log if episode.seed in seeds]
    return found


def _agreement(path: Path) -> dict[str, Table]:
    agreement = load_agreement(path)
    return {
        name: make_table(", ".join(agreement.methods), rows)
        for name, rows in together_rows(agreement).items()
    }


def _offline(path: Path) -> dict[str, Table]:
    results = load_offline(path)
    rows = {"methods": error_rows(results), "agreement": agreement_rows(results)}
    return {name: make_table(results.task, of_one) for name, of_one in rows.items()}


def _carried_noise(path: Path) -> dict[str, Table]:
    results = load_carried_noise(path)
    return {"samplers": make_table(results.task, carried_noise_rows(results))}


def _stopping(path: Path) -> dict[str, Table]:
    results = load_stopping(path)
    return {
        name: make_table(f"{results.trials} trials", rows) for name, rows in stopping_rows(results).items()
    }


_OF_EPISODES: dict[str, tuple[Callable, Callable, str]] = {
    "completed": (told_completed, lambda told, _: completed_rows(told), "that count its parts"),
    "ways": (count_modes, lambda told, _: way_rows(told), "that tell their ways"),
    "scores": (
        told_scores,
        lambda told, results: score_rows(told, results.dense.paired_vs_dense.margin),
        "with scores",
    ),
}
_OF_PAIRS = ("method", "against", "success", "difference, points", "verdict", "McNemar's p")
_READERS = {
    "results": results_tables,
    "acceleration": acceleration_tables,
    "realtime": realtime_tables,
    **READERS,
    "offline_agreement": _agreement,
    "offline_errors": _offline,
    "carried_noise": _carried_noise,
    "stopping": _stopping,
}
