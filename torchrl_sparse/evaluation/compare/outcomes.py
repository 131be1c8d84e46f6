"""Episodes as every file of results tells them: where one began, whether it was solved, and after how many steps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from torchrl_sparse.errors import InputError

__all__ = ["Errors", "MethodOutcomes", "Outcome", "Start", "as_boolean", "as_count", "settle_errors"]

Errors = Literal["refuse", "failure", "exclude"]
"""What an episode that ended in an error counts as."""

_WORDS = {"true": True, "false": False, "1": True, "0": False, "1.0": True, "0.0": False}


@dataclass(frozen=True)
class Start:
    """Where an episode began: episodes of two methods with the same are a pair.

    Attributes:
        task: its name in the file; empty where the file names none.
        kind: whether ``number`` is a seed or the episode's place in its file.
        number: the seed or the place.
        run: the seed of its whole run, where a place is one of many that this seed fixes; empty where it is not known.
    """

    task: str
    kind: Literal["seed", "index"]
    number: int
    run: str = ""


@dataclass(frozen=True)
class Outcome:
    """An episode.

    Attributes:
        start: where it began; None where a file tells counts alone.
        success: whether it was solved; False of one that ended in an error.
        steps: environment steps; None where the file does not tell.
        score: highest reward of a step; None where the file does not tell.
        error: why it could not be played to its end; empty of an ordinary one.
        more: other numbers that a table of episodes shows.
    """

    start: Start | None
    success: bool
    steps: int | None = None
    score: float | None = None
    error: str = ""
    more: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MethodOutcomes:
    """All episodes of a method.

    Attributes:
        name: of the method.
        source: file that they were read from.
        outcomes: of the episodes, at least one.
        horizon: steps after which an episode is truncated; None where the file does not tell.
        stopped: whether their number followed from the verdict, as of a benchmark with ``until=conclusive``.

    Raises:
        InputError: naming the file, if there is no episode, or two began at the same.
    """

    name: str
    source: str
    outcomes: Sequence[Outcome]
    horizon: int | None = None
    stopped: bool = False

    def __post_init__(self) -> None:
        if not self.outcomes:
            raise InputError(f"{self.source}: expected episodes of {self.name}, got none")
        starts = Counter(outcome.start for outcome in self.outcomes if outcome.start is not None)
        if twice := [start for start, count in starts.items() if count > 1]:
            start = twice[0]
            of_task = f" of {start.task}" if start.task else ""
            raise InputError(
                f"{self.source}: {start.kind}: expected one episode of {self.name} for each, got {starts[start]} "
                f"for {start.number}{of_task}; leave the one that counts"
            )

    @property
    def tasks(self) -> set[str]:
        """Names of its tasks, as far as the file tells them."""
        return {outcome.start.task for outcome in self.outcomes if outcome.start and outcome.start.task}

    @property
    def solved(self) -> int:
        """Episodes that were solved."""
        return sum(outcome.success for outcome in self.outcomes)

    @property
    def by_start(self) -> dict[Start, Outcome]:
        """Episodes of which it is known where they began."""
        return {outcome.start: outcome for outcome in self.outcomes if outcome.start is not None}


def settle_errors(method: MethodOutcomes, errors: Errors) -> MethodOutcomes:
    """Count episodes that ended in an error as the user chooses.

    Raises:
        InputError: if there is one and they are to be refused, or no other episode is left.
    """
    failed = [outcome for outcome in method.outcomes if outcome.error]
    if not failed or errors == "failure":
        return method
    if errors == "refuse":
        raise InputError(
            f"{method.source}: expected every episode of {method.name} to be played to its end, got {len(failed)} that "
            f"ended in an error ({failed[0].error}); errors=failure counts them as failures, errors=exclude leaves them out"
        )
    return replace(method, outcomes=[outcome for outcome in method.outcomes if not outcome.error])


def as_boolean(value: Any, where: str) -> bool:
    """Read a success; refuse words that are no booleans.

    >>> as_boolean("True", "a.csv:2: success"), as_boolean(0.0, "a.json: success")
    (True, False)
    """
    if isinstance(value, str) and value.strip().lower() in _WORDS:
        return _WORDS[value.strip().lower()]
    if isinstance(value, (bool, int, float)) and value in (0, 1):
        return bool(value)
    raise InputError(f"{where}: expected true, false, 1 or 0, got {value!r}")


def as_count(value: Any, where: str) -> int:
    """Read a whole number of at least 0, also one that is written as a float or as a text.

    >>> as_count("31", "a.csv:2: steps"), as_count(400.0, "a.json: steps")
    (31, 400)
    """
    try:
        number = float(value) if isinstance(value, str) else value
        if not isinstance(number, bool) and number >= 0 and number == int(number):
            return int(number)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{where}: expected a whole number of at least 0, got {value!r}")
