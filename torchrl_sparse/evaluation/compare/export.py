"""Episodes for other tools: a tidy table, and LeRobot's layout."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import MethodOutcomes, Outcome
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import write_json

__all__ = ["episode_rows", "lerobot_info", "write_episodes", "write_lerobot"]

_FIRST = ("task", "method", "seed", "index", "success", "steps", "score", "error")


def episode_rows(methods: Sequence[MethodOutcomes]) -> list[dict[str, Any]]:
    """Return a row per episode, all with the same columns; None where a file does not tell. A column of nothing is left out."""
    more = {name: None for method in methods for outcome in method.outcomes for name in outcome.more}
    rows = [_row(method.name, outcome, more) for method in methods for outcome in method.outcomes]
    told = [name for name in rows[0] if any(row[name] not in (None, "") for row in rows)]
    return [{name: row[name] for name in told} for row in rows]


def _row(name: str, outcome: Outcome, more: Mapping[str, None]) -> dict[str, Any]:
    start = outcome.start
    number = {start.kind: start.number} if start else {}
    values = (start.task if start else "", name, number.get("seed"), number.get("index"))
    told = (outcome.success, outcome.steps, outcome.score, outcome.error)
    return dict(zip(_FIRST, values + told, strict=True)) | {**more, **outcome.more}


def write_episodes(methods: Sequence[MethodOutcomes], path: str | os.PathLike) -> Path:
    """Write all episodes as one tidy table, ``.csv`` or, where pyarrow is installed, ``.parquet``; return the path.

    Args:
        methods: whose episodes.
        path: of the file, whose suffix says which.

    Raises:
        InputError: for another suffix.
        ImportError: of Parquet without pyarrow.
    """
    path, rows = Path(path), episode_rows(methods)
    if path.suffix == ".csv":
        with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows([{**row, "success": str(row["success"]).lower()} for row in rows])
        return path
    if path.suffix != ".parquet":
        raise InputError(f"table_file: expected a path that ends in .csv or .parquet, got {str(path)!r}")
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError(
            f"table_file: expected pyarrow for {path}, got none; a .csv needs nothing"
        ) from error
    with atomic_path(path) as temporary:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), temporary)
    return path


def lerobot_info(method: MethodOutcomes) -> dict[str, Any]:
    """Return a method's episodes as `lerobot-eval` 0.4.4 writes them, and ``per_episode`` with seeds beside them.

    Rewards are not known of every file: where no score is told, they are those of a task that pays 1 where it is solved. Where
    one is, the highest reward is it, and the sum of rewards, which nobody noted, is null. So are durations.
    """
    by_task: dict[str, list[Outcome]] = {}
    for outcome in method.outcomes:
        by_task.setdefault(outcome.start.task if outcome.start else "", []).append(outcome)
    per_task = [
        {"task_group": task or "task", "task_id": 0, "metrics": _metrics(outcomes)}
        for task, outcomes in by_task.items()
    ]
    return {
        "per_task": per_task,
        "per_group": {
            one["task_group"]: _aggregate([*by_task.values()][i]) for i, one in enumerate(per_task)
        },
        "overall": _aggregate(method.outcomes) | {"eval_s": None, "eval_ep_s": None},
        "per_episode": [_episode(index, outcome) for index, outcome in enumerate(method.outcomes)],
    }


def _rewards(outcome: Outcome) -> tuple[float | None, float]:
    """Return the sum of an episode's rewards and the highest."""
    solved = float(outcome.success)
    return (solved, solved) if outcome.score is None else (None, outcome.score)


def _metrics(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    sums, highest = zip(*map(_rewards, outcomes), strict=True)
    solved = [outcome.success for outcome in outcomes]
    return {"sum_rewards": [*sums], "max_rewards": [*highest], "successes": solved, "video_paths": []}


def _aggregate(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    metrics, n = _metrics(outcomes), len(outcomes)
    sums = metrics["sum_rewards"]
    return {
        "avg_sum_reward": None if None in sums else sum(sums) / n,
        "avg_max_reward": sum(metrics["max_rewards"]) / n,
        "pc_success": 100 * sum(metrics["successes"]) / n,
        "n_episodes": n,
        "video_paths": [],
    }


def _episode(index: int, outcome: Outcome) -> dict[str, Any]:
    start, (total, highest) = outcome.start, _rewards(outcome)
    told = {"task": start.task} if start and start.task else {}
    steps = {} if outcome.steps is None else {"steps": outcome.steps}
    return {
        "episode_ix": start.number if start and start.kind == "index" else index,
        "sum_reward": total,
        "max_reward": highest,
        "success": outcome.success,
        "seed": start.number if start and start.kind == "seed" else None,
        **told,
        **steps,
    }


def write_lerobot(methods: Sequence[MethodOutcomes], folder: str | os.PathLike) -> Path:
    """Write ``METHOD/eval_info.json`` of every method into a new folder, whole or not at all; return the folder.

    Raises:
        InputError: if the folder is there already, or a name is no name of a folder.
    """
    folder = Path(folder)
    if folder.exists():
        raise InputError(f"lerobot: expected a folder that is not there yet, got {folder}")
    names = {method.name: method.name.replace("/", "_") for method in methods}
    if len({*names.values()}) < len(names) or {".", ".."} & {*names.values()}:
        raise InputError(f"lerobot: expected names of methods that differ as folders, got {', '.join(names)}")
    unfinished = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        for method in methods:
            write_json(unfinished / names[method.name] / "eval_info.json", lerobot_info(method))
        os.replace(unfinished, folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder
