"""Episodes of LeRobot's ``eval_info.json``, as `lerobot-eval` 0.4.4 and 0.6.1 write it, or with ``per_episode``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import Outcome, Start, as_boolean, as_count

__all__ = ["is_lerobot", "read_lerobot"]


def is_lerobot(data: Mapping[str, Any]) -> bool:
    """Tell such a file by its keys."""
    return "per_episode" in data or "per_task" in data


def read_lerobot(path: str, data: Mapping[str, Any]) -> list[Outcome]:
    """Return the episodes: by their seeds where the file has these, else by their places in each task.

    Current files have ``per_task`` alone, without seeds: a place is a start only as far as runs had the same ``seed``.

    Raises:
        InputError: naming file and entry.
    """
    if "per_episode" in data:
        return [_episode(path, index, entry) for index, entry in enumerate(_list(data, "per_episode", path))]
    outcomes = []
    for number, entry in enumerate(_list(data, "per_task", path)):
        where = f"{path}: per_task.{number}"
        if not isinstance(entry, Mapping) or not isinstance(entry.get("metrics"), Mapping):
            raise InputError(f"{where}: expected task_group, task_id and metrics, got {_short(entry)}")
        task = f"{entry.get('task_group')}/{entry.get('task_id')}"
        successes = _list(entry["metrics"], "successes", f"{where}.metrics")
        scores = entry["metrics"].get("max_rewards")
        if not isinstance(scores, list) or len(scores) != len(successes):
            scores = [None] * len(successes)
        for index, (success, score) in enumerate(zip(successes, scores, strict=True)):
            solved = as_boolean(success, f"{where}.metrics.successes.{index}")
            outcomes.append(Outcome(Start(task, "index", index), solved, score=_score(score)))
    return outcomes


def _episode(path: str, index: int, entry: Any) -> Outcome:
    where = f"{path}: per_episode.{index}"
    if not isinstance(entry, Mapping) or "success" not in entry:
        raise InputError(f"{where}: expected an episode with success, got {_short(entry)}")
    seed, task = entry.get("seed"), entry.get("task", "")
    start = (
        Start(task, "index", as_count(entry.get("episode_ix", index), f"{where}.episode_ix"))
        if seed is None
        else Start(task, "seed", as_count(seed, f"{where}.seed"))
    )
    steps = entry.get("steps")
    return Outcome(
        start,
        as_boolean(entry["success"], f"{where}.success"),
        None if steps is None else as_count(steps, f"{where}.steps"),
        _score(entry.get("max_reward")),
    )


def _list(data: Mapping[str, Any], key: str, where: str) -> list[Any]:
    found = data.get(key)
    if not isinstance(found, list):
        raise InputError(f"{where}: {key}: expected a list, got {_short(found)}")
    return found


def _score(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


def _short(value: Any) -> str:
    return repr(value)[:80]
