"""Episodes of vla-eval's results, as its version 0.8.0 exports them: a JSON file per benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import Outcome, Start, as_boolean, as_count

__all__ = ["is_vla_eval", "read_vla_eval"]


def is_vla_eval(data: Mapping[str, Any]) -> bool:
    """Tell such a file by its keys."""
    return "benchmark" in data and "tasks" in data


def read_vla_eval(path: str, data: Mapping[str, Any]) -> list[Outcome]:
    """Return the episodes: by task and ``episode_id``, and the run's seed where it is noted.

    vla-eval counts an episode with a ``failure_reason`` as a failure; here it is one that ended in an error.

    Raises:
        InputError: naming file and entry.
    """
    run = "" if data.get("seed") is None else str(data["seed"])
    if not isinstance(data["tasks"], list):
        raise InputError(f"{path}: tasks: expected a list, got {data['tasks']!r}"[:200])
    outcomes = []
    for number, task in enumerate(data["tasks"]):
        where = f"{path}: tasks.{number}"
        if not isinstance(task, Mapping) or not isinstance(task.get("episodes"), list):
            raise InputError(f"{where}: expected task and episodes, got {task!r}"[:200])
        name = f"{data['benchmark']}/{task.get('task')}"
        for index, episode in enumerate(task["episodes"]):
            outcomes.append(_episode(f"{where}.episodes.{index}", name, run, episode))
    return outcomes


def _episode(where: str, task: str, run: str, episode: Any) -> Outcome:
    if not isinstance(episode, Mapping):
        raise InputError(f"{where}: expected an episode, got {episode!r}"[:200])
    start = Start(task, "index", as_count(episode.get("episode_id"), f"{where}.episode_id"), run)
    if reason := episode.get("failure_reason"):
        return Outcome(start, False, error=str(reason))
    metrics = episode.get("metrics")
    success = metrics.get("success") if isinstance(metrics, Mapping) else None
    steps = episode.get("steps")
    return Outcome(
        start,
        as_boolean(success, f"{where}.metrics.success"),
        None if steps is None else as_count(steps, f"{where}.steps"),
    )
