"""Reading and writing of all JSON files of this package as dataclasses.

The dataclass is the schema: its fields are the only keys, its annotations their types, and its ``__post_init__`` checks what
types cannot say, with messages that begin with the field (``"rate: expected k / n, got 2"``). A field with the default None
is left out of the file where it is None; ``format: Literal["name/1"]`` comes first, so that a file of another format is
named as such.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.fingerprint import is_same_policy
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["check_plain", "describe_differences", "parse_json", "read_json", "to_plain", "write_json"]

T = TypeVar("T")
# The largest file of ours, the words of a Llama tokenizer, has a few million bytes and sixty thousand lists.
MAX_BYTES, MAX_PARTS = 64 << 20, 1 << 18
_NAMED = 12  # differing keys that are named


def read_json(path: str | os.PathLike, kind: type[T]) -> T:
    """Read a JSON file as ``kind``: a dataclass, or any type of JSON values, such as ``dict[str, Any]``.

    Types are strict (``true`` is no integer and ``1.0`` neither), numbers finite, and no key may be unknown or stand twice.

    Raises:
        FileNotFoundError: if there is no such file.
        InputError: ``FILE: key: expected …, got …``, also for a file that is huge or deep or of too many parts.

    Examples:
        >>> import tempfile
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Rate:
        ...     solved: int
        ...     of: int
        >>> file = write_json(Path(tempfile.mkdtemp()) / "rate.json", Rate(3, 4))
        >>> read_json(file, Rate)
        Rate(solved=3, of=4)
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"expected a file {path}, got none")
    _check_size(path.stat().st_size, str(path))
    return parse_json(path.read_bytes(), kind, str(path))


def parse_json(text: str | bytes, kind: type[T], where: str) -> T:
    """Parse JSON text, a file's or a line's, as `read_json` does.

    Args:
        text: the JSON.
        kind: what to make of it.
        where: names the text in errors.

    Raises:
        InputError: ``WHERE: key: expected …, got …``.

    >>> parse_json('{"solved": true}', dict[str, int], "line 3")
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: line 3: solved: expected a valid integer, got True
    """
    from pydantic import ValidationError
    from pydantic_core import from_json

    data = text.encode() if isinstance(text, str) else text
    _check_size(len(data), where)
    parts = data.count(b"[") + data.count(b"{")
    if parts > MAX_PARTS:  # of an empty list, two bytes, Python makes sixty
        raise InputError(f"{where}: expected at most {MAX_PARTS} lists and objects, got {parts}")
    try:
        read = from_json(data, allow_inf_nan=False)  # also where a field may hold anything
    except ValueError as error:
        raise InputError(f"{where}: expected a complete JSON file, got: {error}") from error
    try:
        made = _adapter(kind).validate_json(b"[%b]" % data)[0]  # type: ignore[arg-type]  # classes have a hash
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(error.errors(include_url=False)[0])}") from error
    try:
        json.loads(b'{"": %b}' % data, object_pairs_hook=_once)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    if _names_numbers(kind):  # type: ignore[arg-type]  # classes have a hash
        _check_numbers(read, to_plain(made), where)
    return made


def check_plain(value: Any, kind: type[T], where: str) -> T:
    """Build ``kind`` from plain values, checked as strictly as `read_json` checks a file.

    Raises:
        InputError: ``WHERE: key: expected …, got …``.

    >>> check_plain("few", int, "episodes")
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: episodes: expected a valid integer, got 'few'
    """
    from pydantic import ValidationError

    try:
        made = _adapter(kind).validate_python((value,))[0]  # type: ignore[arg-type]  # classes have a hash
    except ValidationError as error:
        raise InputError(f"{where}: {_fault(error.errors(include_url=False)[0])}") from error
    if _names_numbers(kind):  # type: ignore[arg-type]  # classes have a hash
        _check_numbers(value, to_plain(made), where)
    return made


def write_json(path: str | os.PathLike, value: Any) -> Path:
    """Write a dataclass, or plain JSON values, atomically, and return the path.

    Raises:
        TypeError: if ``value`` holds something that JSON cannot.
        InputError: naming file and key, if `read_json` would refuse the file.
    """
    path = Path(path)
    try:
        text = json.dumps(to_plain(value), indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise type(error)(f"{path}: {error}") from error
    parse_json(text, type(value) if is_dataclass(value) else Any, str(path))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def describe_differences(found: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """Return the keys, dotted for nested mappings, in which plain values differ, with both values; empty if equal.

    A fingerprint of a policy equals what earlier files note of that policy, see `is_same_policy`.

    >>> describe_differences({"seed": 1, "task": "lift"}, {"seed": 2, "task": "lift"})
    'seed is 2 here and 1 there'
    >>> describe_differences({"train": {"lr": 1, "seed": 0}}, {"train": {"lr": 2, "seed": 0}})
    'train.lr is 2 here and 1 there'
    """
    nothing, found, asked = object(), _flat(found), _flat(asked)

    def say(values: Mapping[str, Any], key: str) -> str:
        return _short(values[key]) if key in values else "missing"

    keys = [
        key
        for key in {**found, **asked}
        if not is_same_policy(found.get(key, nothing), asked.get(key, nothing))
    ]
    return ", ".join(f"{key} is {say(asked, key)} here and {say(found, key)} there" for key in keys[:_NAMED])


def to_plain(value: Any) -> Any:
    """Convert dataclasses, mappings and sequences to JSON dicts and lists.

    >>> from dataclasses import make_dataclass
    >>> to_plain(make_dataclass("Note", ["text", ("by", str, None)])(text=("a", "b")))
    {'text': ['a', 'b']}
    """
    if is_dataclass(value):
        entries = ((field, getattr(value, field.name)) for field in fields(value))
        return {f.name: to_plain(entry) for f, entry in entries if entry is not None or f.default is not None}
    if isinstance(value, Mapping):
        return {key: to_plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(entry) for entry in value]
    return value


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for key, value in values.items():
        nested = isinstance(value, Mapping) and value
        entries |= _flat(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return entries


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import ConfigDict, TypeAdapter

    # Of a dataclass alone pydantic takes no configuration; within a tuple the dataclass, and those in it, follow the tuple's.
    config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    return TypeAdapter(tuple[kind], config=config)


@cache
def _names_numbers(kind: Any) -> bool:
    """Tell whether a `Literal` of numbers is among the types that ``kind`` is made of."""
    parts = [_adapter(kind).core_schema]
    while parts:
        part = parts.pop()
        if isinstance(part, dict) and part.get("type") == "literal":
            if any(isinstance(value, int) for value in part["expected"]):
                return True
        elif isinstance(part, (dict, list, tuple)):
            parts.extend(part.values() if isinstance(part, dict) else part)
    return False


def _check_numbers(read: Any, made: Any, where: str) -> None:
    """Refuse ``true`` and ``1.0`` where a `Literal` names 1: they are equal, which is all that pydantic asks of those."""
    if isinstance(made, dict) and isinstance(read, Mapping):
        for key in made.keys() & read.keys():
            _check_numbers(read[key], made[key], f"{where}: {key}" if ": " not in where else f"{where}.{key}")
    elif isinstance(made, list) and isinstance(read, (list, tuple)):
        for index, pair in enumerate(zip(read, made, strict=False)):
            _check_numbers(*pair, f"{where}.{index}" if ": " in where else f"{where}: {index}")
    elif (
        isinstance(made, (bool, int))
        and isinstance(read, (bool, int, float))
        and type(read) is not type(made)
    ):
        raise InputError(f"{where}: expected {made!r}, got {read!r}")


def _once(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make an object of its entries; ValueError for an infinity, and for a name that stands twice: parsers keep the last."""
    made = dict(entries)
    if len(made) < len(entries):
        ((twice, count),) = Counter(name for name, _ in entries).most_common(1)
        raise InputError(f"{twice}: expected one entry of this name, got {count}")
    for name, value in entries:
        if isinstance(value, (float, list)) and _is_infinite(value):
            raise InputError(f"{f'{name}: ' if name else ''}expected finite numbers, got one beyond floats")
    return made


def _is_infinite(value: Any) -> bool:
    if isinstance(value, list):
        return any(map(_is_infinite, value))
    return isinstance(value, float) and math.isinf(value)


def _check_size(size: int, where: str) -> None:
    if size > MAX_BYTES:
        raise InputError(f"{where}: expected at most {MAX_BYTES} bytes of JSON, got {size}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _fault(error: Mapping[str, Any]) -> str:
    """Say what pydantic found in this package's words."""
    key = ".".join(str(part) for part in error["loc"][1:])
    place = f"{key}: " if key else ""
    got = _short(error["input"])
    if error["type"] == "missing":
        return f"{place}expected this key, got nothing"
    if error["type"] == "unexpected_keyword_argument":
        return f"{place}expected no such key, got {got}"
    if error["type"] == "value_error":
        return f"{key}.{error['ctx']['error']}" if key else str(error["ctx"]["error"])
    expected = re.sub(r"^\w+ should (be|have) ", "", error["msg"])
    return f"{place}expected {expected}, got {got}"
