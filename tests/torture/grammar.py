"""What can be wrong with a file: a grammar of changes to a JSON document, and of damage to any file's bytes."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

Path = tuple[Any, ...]

WRONG_TYPES = {
    bool: ["yes", 1],
    int: ["7", 1.5, True, [3]],
    float: ["x", [1.0], {}],
    str: [7, ["a"]],
    list: [{}, "a, b", 3],
    dict: [[], "{}"],
    type(None): [],
}
"""Per type of an entry, what must not stand there."""

OUT_OF_BOUNDS = [-1, 0, 10**12, 2**63, 10**30]
"""Numbers that no size, count or step is; an entry that may hold one is allowed to be answered."""


@dataclass(frozen=True)
class Change:
    """A malformed document.

    Attributes:
        name: of the change.
        key: that an error must name; None where the document may also be answered.
        content: the document, or the bytes of a file.
    """

    name: str
    key: str | None
    content: Any


def changes(document: Any, *, free: set[str], optional: set[str]) -> Iterator[Change]:
    """Yield every change of a document: entries dropped, of wrong types, out of bounds, and unknown ones.

    Args:
        document: a valid one.
        free: keys below which anything may stand; only they themselves are changed.
        optional: keys that need not be there.
    """
    for path, value in _entries(document, free):
        name, key = ".".join(map(str, path)), _key(path)
        if isinstance(path[-1], str):
            yield Change(f"{name} dropped", None if key in optional else key, _without(document, path))
        yield Change(f"{name} is null", None if key in optional else key, _with(document, path, None))
        for wrong in (wrong for wrong in WRONG_TYPES[type(value)] if wrong != value):  # true is 1
            yield Change(f"{name} is {wrong!r}", key, _with(document, path, wrong))
        if type(value) is int:
            for number in OUT_OF_BOUNDS:
                yield Change(f"{name} is {number}", None, _with(document, path, number))
        if isinstance(value, dict) and key not in free:
            yield Change(
                f"{name} has an unknown entry", "unheard_of", _with(document, (*path, "unheard_of"), 1)
            )
    yield Change("an unknown entry", "unheard_of", {**document, "unheard_of": 1})


def _entries(node: Any, free: set[str], path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield every entry with its path; of a list the first and the last."""
    if isinstance(node, dict):
        steps = list(node)
    elif isinstance(node, list):
        steps = sorted({0, len(node) - 1}) if node else []
    else:
        steps = []
    for step in steps:
        yield (*path, step), node[step]
        if step not in free:
            yield from _entries(node[step], free, (*path, step))


def _key(path: Path) -> str:
    """Return the name nearest to an entry: its own, or that of the list that it is in."""
    return next(step for step in reversed(path) if isinstance(step, str))


def _with(document: Any, path: Path, value: Any) -> Any:
    changed = copy.deepcopy(document)
    node = changed
    for step in path[:-1]:
        node = node[step]
    node[path[-1]] = value
    return changed


def _without(document: Any, path: Path) -> Any:
    changed = copy.deepcopy(document)
    node = changed
    for step in path[:-1]:
        node = node[step]
    del node[path[-1]]
    return changed


def damage(whole: bytes, rng: random.Random) -> Iterator[Change]:
    """Yield damaged bytes of any file: cut off, empty, of other formats, and with single bytes changed."""
    for share in (0.1, 0.5, 0.9):
        yield Change(f"cut to {share:.0%}", "", whole[: int(len(whole) * share)])
    yield Change("empty", "", b"")
    yield Change("zeros", "", bytes(len(whole)))
    yield Change("text", "", b"not what it should be\n" * 20)
    yield Change("gzip", "", b"\x1f\x8b\x08" + rng.randbytes(300))
    for number in range(6):
        broken = bytearray(whole)
        for _ in range(rng.choice([1, 3, 20])):
            broken[rng.randrange(len(broken))] = rng.randrange(256)
        yield Change(f"random bytes {number}", None, bytes(broken))


def hostile_json(document: dict[str, Any]) -> Iterator[Change]:
    """Yield texts in JSON's neighbourhood that exhaust or confuse readers."""
    text, first = json.dumps(document), next(iter(document))
    yield Change("deep lists", "", b"[" * 200_000 + b"]" * 200_000)
    yield Change(
        "deep entry", "", text.replace("{", '{"deep": ' + "[" * 5_000 + "]" * 5_000 + ", ", 1).encode()
    )
    yield Change("deep dicts", "", b'{"a":' * 100_000 + b"1" + b"}" * 100_000)
    yield Change("endless number", "", text.replace("{", '{"n": ' + "9" * 2_000_000 + ", ", 1).encode())
    yield Change("not a number", "", text.replace("{", '{"n": NaN, ', 1).encode())
    yield Change("infinity", "", text.replace("{", '{"n": 1e999, ', 1).encode())
    yield Change("not UTF-8", "", text.replace("{", '{"ä": "ö", ', 1).encode("latin-1"))
    yield Change("lone surrogate", "", text.replace("{", '{"n": "\\ud800", ', 1).encode())
    yield Change("NUL bytes", "", text.replace("{", '{"\0": 1, ', 1).encode())
    yield Change("UTF-16", "", text.encode("utf-16"))
    yield Change("two documents", "", f"{text}\n{text}".encode())
    yield Change("a list", "", json.dumps([document]).encode())
    yield Change("a word", "", b'"words"')
    yield Change(f"{first} twice", None, text.replace("{", "{" + f'"{first}": 0, ', 1).encode())
    yield Change(
        "a hundred thousand entries",
        "",
        json.dumps(document | dict.fromkeys(map(str, range(100_000)))).encode(),
    )
