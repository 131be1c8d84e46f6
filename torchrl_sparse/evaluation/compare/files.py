"""Which kind of file it is, and what its methods are called."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.lerobot import is_lerobot, read_lerobot
from torchrl_sparse.evaluation.compare.outcomes import Errors, MethodOutcomes, Outcome, Start, settle_errors
from torchrl_sparse.evaluation.compare.robomimic_log import read_robomimic_log
from torchrl_sparse.evaluation.compare.table import read_table
from torchrl_sparse.evaluation.compare.vla_eval import is_vla_eval, read_vla_eval
from torchrl_sparse.evaluation.results.aggregate import counted_episodes
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, read_episodes, read_identity
from torchrl_sparse.storage.json import read_json

__all__ = ["read_methods"]

_GENERIC = ("results", "eval_info", "log", "episodes")  # names of files that say nothing of what is in them
_KNOWN = "our results.json or episodes folder, LeRobot's eval_info.json, results of vla-eval, a log of robomimic, or a CSV"
_MOST_BYTES = 64 << 20


def read_methods(paths: Sequence[str | os.PathLike], errors: Errors = "refuse") -> list[MethodOutcomes]:
    """Read the episodes of all methods in these files, in their order; of ours dense is the first.

    A method is called as its file calls it; one of a file that names none, as the file or, where that says nothing, its
    folder. Methods of the same name get the name of their file as a prefix.

    Args:
        paths: of files, or of folders that hold ``results.json``, ``eval_info.json`` or logs of episodes.
        errors: what episodes that ended in an error count as.

    Raises:
        FileNotFoundError: if there is no such file.
        InputError: naming file and entry, if one is of no kind that is known, or damaged.
    """
    if not paths:
        raise InputError(f"files: expected {_KNOWN}, got none")
    found = [method for path in paths for method in _read(_chosen(Path(path)))]
    twice = Counter(method.name for method in found)
    named = [
        replace(method, name=f"{_label(Path(method.source))}/{method.name}")
        if twice[method.name] > 1
        else method
        for method in found
    ]
    if len({method.name for method in named}) < len(named):
        named = [replace(method, name=f"{method.source}/{method.name}") for method in named]
    if len({method.name for method in named}) < len(named):
        raise InputError(f"files: expected each once, got {', '.join(map(str, paths))}")
    return [settle_errors(method, errors) for method in named]


def _chosen(path: Path) -> Path:
    """Return the file that a folder is about, or the folder itself where it holds logs."""
    if not path.is_dir():
        return path
    for name in ("results.json", "eval_info.json", "episodes"):
        if (path / name).exists():
            return path / name
    return path


def _read(path: Path) -> list[MethodOutcomes]:
    if path.is_dir():
        logs = sorted({_log_name(log) for log in (*path.glob("*.jsonl"), *path.glob("*.jsonl.gz"))})
        if not logs:
            raise FileNotFoundError(f"{path}: expected {_KNOWN} in it, got none")
        logs.sort(key=lambda name: name != "dense")
        return [_of_log(path / f"{name}.jsonl") for name in logs]
    if path.name.endswith((".jsonl", ".jsonl.gz")):
        return [_of_log(path.with_name(f"{_log_name(path)}.jsonl"))]
    if not path.is_file():
        raise FileNotFoundError(f"expected a file {path}, got none")
    if path.suffix == ".csv":
        return [_named(path, name, outcomes) for name, outcomes in read_table(path).items()]
    if path.suffix == ".json":
        return _of_json(path)
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path}: expected at most {_MOST_BYTES} bytes of a log, got {path.stat().st_size}")
    try:
        found = read_robomimic_log(str(path), path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected {_KNOWN}, got bytes that are no text") from error
    return [_named(path, name, outcomes) for name, outcomes in found.items()]


def _of_json(path: Path) -> list[MethodOutcomes]:
    data = read_json(path, dict[str, Any])
    if is_lerobot(data):
        return [_named(path, "", read_lerobot(str(path), data))]
    if is_vla_eval(data):
        return [_named(path, "", read_vla_eval(str(path), data))]
    if "schema" not in data:
        raise InputError(
            f"{path}: expected {_KNOWN}, got an object of {', '.join(sorted(data))[:200] or 'nothing'}"
        )
    results = load_results(path)
    return [
        MethodOutcomes(
            name,
            str(path),
            [
                _outcome(results.task, episode)
                for episode in counted_episodes(path, results, name, entry.success.n)
            ],
            results.episode_horizon,
            results.until_conclusive is not None,
        )
        for name, entry in results.methods.items()
    ]


def _of_log(path: Path) -> MethodOutcomes:
    identity, episodes = read_identity(path), read_episodes(path)
    task = str(identity.get("task", ""))
    return MethodOutcomes(_log_name(path), str(path), [_outcome(task, episode) for episode in episodes])


def _outcome(task: str, episode: EpisodeResult) -> Outcome:
    more = {"queries": episode.queries, "flops": episode.flops_total, "prune_rate": episode.prune_rate}
    start = Start(task, "seed", episode.seed)
    return Outcome(start, episode.success, episode.length, episode.score, more=more)


def _named(path: Path, name: str, outcomes: list[Outcome]) -> MethodOutcomes:
    return MethodOutcomes(name or _label(path), str(path), outcomes)


def _log_name(path: Path) -> str:
    return path.name.removesuffix(".gz").removesuffix(".jsonl")


def _label(path: Path) -> str:
    """Return what a file is called, or, where that says nothing, its folder.

    >>> _label(Path("runs/fast/eval_info.json")), _label(Path("runs/fast.csv"))
    ('fast', 'fast')
    """
    stem, folders = _log_name(path).partition(".")[0], path.resolve().parts[-2::-1]
    if stem not in _GENERIC:
        return stem
    return next((folder for folder in folders if folder not in _GENERIC), stem)
