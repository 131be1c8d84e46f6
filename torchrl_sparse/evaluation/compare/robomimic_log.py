"""Episodes of robomimic's logs, as its version 0.3.0 prints them.

Its trainer prints means of each evaluation; with ``verbose`` a line of each episode too. ``run_trained_agent`` prints means and
the number of successes. Means tell counts, of episodes whose starts nobody knows: they pair with nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import Outcome, Start

__all__ = ["read_robomimic_log"]

_BEGIN = re.compile(r"^rollout: env=(.+?), horizon=(\d+), .*num_episodes=(\d+)$")
_EPISODE = re.compile(r"^Episode (\d+), horizon=(\d+), num_success=([\d.]+)$")
_EPOCH = re.compile(r"^Epoch (\d+) Rollouts took")
_ENV = re.compile(r"^Env: (.+)$")


def read_robomimic_log(path: str, text: str) -> dict[str, list[Outcome]]:
    """Return the episodes of every evaluation in a log: its name, ``ENV epoch N``, or empty of ``run_trained_agent``.

    Raises:
        InputError: naming file and line, if there is none, or counts do not agree.
    """
    found: dict[str, list[Outcome]] = {}
    lines = text.splitlines()
    told: dict[str, list[Outcome]] = {}  # of environments whose results are still to come
    numbers: dict[str, int] = {}
    env, before, epoch = "", 0, ""
    for index, line in enumerate(lines):
        where = f"{path}:{index + 1}"
        if match := _BEGIN.match(line.strip()):
            env, before = match[1], 0
            told[env], numbers[env] = [], int(match[3])
        elif match := _EPISODE.match(line.strip()):
            solved = float(match[3]) - before
            if solved not in (0, 1):
                raise InputError(f"{where}: num_success: expected {before} or {before + 1}, got {match[3]}")
            before = int(float(match[3]))
            start, steps = Start(env, "index", int(match[1])), _steps(lines, index + 1, where)
            told.setdefault(env, []).append(Outcome(start, bool(solved), steps))
        elif match := _EPOCH.match(line.strip()):
            epoch = match[1]
        elif (match := _ENV.match(line.strip())) and epoch:
            if match[1] not in numbers:
                raise InputError(f"{where}: expected a line 'rollout: env={match[1]}, …' before it, got none")
            name = f"{match[1]} epoch {epoch}"
            if name in found:
                raise InputError(f"{where}: expected one evaluation of {name}, got two; cut the log")
            means = _means(lines, index + 1, where)
            found[name] = told.pop(match[1], None) or _counted(numbers.pop(match[1]), means, where)
            epoch = ""
        elif line.strip() == "Average Rollout Stats":
            means = _means(lines, index + 1, where)
            rate, solved = means.get("Success_Rate", 0.0), means.get("Num_Success")
            if not rate or solved is None:
                raise InputError(
                    f"{where}: expected Success_Rate above 0 and Num_Success, which tell the number of rollouts, got {means}; "
                    "write what it printed as a CSV of index, success"
                )
            if "" in found:
                raise InputError(f"{where}: expected one evaluation, got two; cut the log")
            found[""] = _counted(round(solved / rate), means, where)
    if not found and len(told) == 1:
        found[""] = next(iter(told.values()))
    if not found:
        raise InputError(f"{path}: expected results of rollouts in a log of robomimic, got none")
    return found


def _counted(number: int, means: dict[str, float], where: str) -> list[Outcome]:
    solved = means.get("Success_Rate", -1.0) * number
    if not 0 <= solved <= number or abs(solved - round(solved)) > 1e-6 * max(number, 1):
        raise InputError(
            f"{where}: Success_Rate: expected a share of {number} rollouts, got {means.get('Success_Rate')}"
        )
    return [Outcome(None, index < round(solved)) for index in range(number)]


def _steps(lines: list[str], index: int, where: str) -> int | None:
    horizon = _means(lines, index, where).get("Horizon")
    return None if horizon is None else int(horizon)


def _means(lines: list[str], index: int, where: str) -> dict[str, float]:
    """Read the JSON object that begins at a line."""
    text = "\n".join(_object(lines, index))
    try:
        found = json.loads(text)
    except ValueError as error:
        raise InputError(f"{where}: expected a JSON object after this line, got: {error}") from error
    return {name: float(value) for name, value in found.items() if isinstance(value, (int, float))}


def _object(lines: list[str], index: int) -> Iterator[str]:
    for line in lines[index:]:
        yield line
        if line.rstrip() == "}":
            return
