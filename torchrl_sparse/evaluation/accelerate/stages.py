"""Files that the stages of an acceleration write, so that an interrupted one resumes.

Each file says what it was made for; under other settings it is refused, or made again where that costs little.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.measure import Latency, Machine
from torchrl_sparse.storage.json import describe_differences, read_json, to_plain, write_json

__all__ = ["Errors", "Search", "Timings", "read_or_make"]


class _Stage(Protocol):
    made_for: dict[str, Any]


S = TypeVar("S", bound=_Stage)


@dataclass(frozen=True)
class Search:
    """Result of a timestep search: the method with the least error, its error, and the number of chains tried."""

    format: Literal["torchrl_sparse.search/1"]
    made_for: dict[str, Any]
    method: str
    error: float
    tried: int


@dataclass(frozen=True)
class Errors:
    """Errors of methods relative to demonstrations."""

    format: Literal["torchrl_sparse.errors/1"]
    made_for: dict[str, Any]
    errors: dict[str, float]


@dataclass(frozen=True)
class Timings:
    """Latencies of methods, measured together, and the machine."""

    format: Literal["torchrl_sparse.timings/1"]
    made_for: dict[str, Any]
    machine: Machine
    timings: dict[str, Latency]


def read_or_make(
    path: Path, kind: type[S], made_for: Mapping[str, Any], make: Callable[[], S], *, remake: bool = False
) -> S:
    """Return the content of the file; if there is none, compute and write it.

    Args:
        path: of the JSON file.
        kind: dataclass of its content.
        made_for: what the content depends on; JSON values.
        make: called at most once.
        remake: whether to make again, instead of refusing, what was made for something else.

    Raises:
        InputError: naming the file, if it is malformed, or was made for something else.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "errors.json"
        >>> errors = Errors("torchrl_sparse.errors/1", {"seed": 1}, {"dense": 0.5})
        >>> read_or_make(path, Errors, {"seed": 1}, lambda: errors) == read_or_make(path, Errors, {"seed": 1}, None)
        True
    """
    if path.exists():
        found = read_json(path, kind)
        differing = describe_differences(found.made_for, to_plain(made_for))
        if not differing:
            return found
        if not remake:
            raise InputError(
                f"{path}: made with other settings: {differing}; choose another out or move it away"
            )
    made = make()
    write_json(path, made)
    return made
