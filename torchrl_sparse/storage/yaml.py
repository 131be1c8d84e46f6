"""Strict reader of handwritten YAML: values as Hydra reads them, and duplicate keys refused.

PyYAML follows YAML 1.1, in which ``1e-4`` is a text and ``2026-01-01`` a date, and keeps the last of two entries of one name.
"""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from torchrl_sparse.errors import InputError

__all__ = ["read_yaml"]

MAX_ENTRIES = (
    1 << 17
)  # of a file whose aliases stand for others, which are few lines for any number of entries
_FLOAT, _DATE, _MERGE = (f"tag:yaml.org,2002:{name}" for name in ("float", "timestamp", "merge"))


class _Loader(yaml.SafeLoader):
    """Loads plain values: a number with an exponent is one, a date is a text, and no name stands twice in a mapping."""

    def compose_mapping_node(self, anchor: str | None) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        names: set[Any] = set()
        for key, _ in node.value:
            if (name := _name(key)) in names:
                raise InputError(f"{_line(key)}: {key.value}: expected one entry of this name, got another")
            names.add(name)
        return node

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Put merged entries (``<<: *other``) in, of which own ones, then earlier ones count: PyYAML's choice varies."""
        merged: dict[Any, Any] = {}
        own: dict[Any, Any] = {}
        for key, value in node.value:
            if key.tag != _MERGE:
                own[_name(key)] = key, value
                continue
            for source in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                if not isinstance(source, yaml.MappingNode):
                    raise InputError(
                        f"{_line(key)}: <<: expected a mapping or a list of them, got another value"
                    )
                self.flatten_mapping(source)
                merged = {_name(pair[0]): pair for pair in source.value} | merged
        node.value = [*(merged | own).values()]


def _name(key: yaml.Node) -> Any:
    return (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else id(key)


def _line(node: yaml.Node) -> str:
    return f"line {node.start_mark.line + 1}"


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _DATE]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    _FLOAT, re.compile(r"[-+]?(\.\d+|\d+(\.\d*)?)[eE][-+]?\d+$", re.ASCII), list("-+.0123456789")
)


def read_yaml(path: str | os.PathLike) -> Any:
    """Read a file as mappings with text keys, lists, texts, finite numbers, truth values and None.

    Raises:
        FileNotFoundError: if there is no such file.
        InputError: naming the file and the line or entry, for what is no YAML, a name that stands twice, or another value.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "sweep.yaml"
    >>> _ = file.write_text("lr: {values: [1e-4, '1e-4', 2026-01-01]}")
    >>> read_yaml(file)
    {'lr': {'values': [0.0001, '1e-4', '2026-01-01']}}
    """
    try:
        read = yaml.load(Path(path).read_bytes(), _Loader)
        for number, (place, fault) in enumerate(_faults(read)):
            if fault or number >= MAX_ENTRIES:
                raise InputError(f"{place}{fault or f'expected at most {MAX_ENTRIES} entries, got more'}")
    except RecursionError as error:
        raise InputError(f"{path}: expected YAML, got one that is too deep") from error
    # of explicit tags, such as !!int on no number, PyYAML lets Python's own errors through
    except (yaml.YAMLError, UnicodeDecodeError, LookupError, AttributeError) as error:
        raise InputError(f"{path}: expected YAML, got {' '.join(str(error).split())}") from error
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    return read


def _faults(value: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """Yield of every value where it stands and what is wrong with it, empty if nothing is."""
    where = f"{place}: " if place else ""
    if isinstance(value, dict):
        for name, entry in value.items():
            inner = f"{place}.{name}" if place else str(name)
            if not isinstance(name, str):
                yield f"{inner}: ", f"expected a text as a name, got {name!r}; put it in quotes"
            yield from _faults(entry, inner)
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            yield from _faults(entry, f"{place}.{index}" if place else str(index))
    elif isinstance(value, float) and not math.isfinite(value):
        yield where, f"expected a finite number, got {value}"
    elif not isinstance(value, (str, int, float)) and value is not None:
        yield where, f"expected a text, number, list or mapping, got {reprlib.repr(value)}"
    yield where, ""
