"""The instruction of each demonstration of a file: ``lang`` of its json attribute ``ep_meta``, as in RoboCasa's files."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import demo_group, demo_names, each_path, open_demos
from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import parse_json

__all__ = ["read_instruction", "read_instructions"]


def read_instruction(demo: Node) -> str | None:
    """Read the instruction of one demonstration; None if it has none.

    Raises:
        InputError: if ``ep_meta`` is no json object or its ``lang`` is no text.
    """
    text = demo.text("ep_meta") or "{}"
    try:
        words = parse_json(text, dict[str, Any], "ep_meta").get("lang")
    except ValueError as error:
        raise InputError(
            f"{demo.where}, ep_meta: expected a json object, got {reprlib.repr(text)}"
        ) from error
    if words is None or isinstance(words, str):
        return words
    raise InputError(f"{demo.where}, ep_meta: expected a text as 'lang', got {reprlib.repr(words)}")


def read_instructions(paths: str | Path | Sequence[str | Path]) -> list[str]:
    """Read the instruction of every demonstration of one or several robomimic files, in the order of `read_demos`.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming file and demonstration, if one has no instruction.

    Examples:
        >>> read_instructions("data/lift_named_proficient.h5")[0]  # doctest: +SKIP
        'lift the green cube'
    """
    return [words for path in each_path(paths) for words in _read_file(path)]


def _read_file(path: str | Path) -> list[str]:
    with open_demos(path) as file:
        data = demo_group(file)
        return [_required(data.group(name)) for name in demo_names(file)]


def _required(demo: Node) -> str:
    if not (words := read_instruction(demo)):
        raise InputError(f"{demo.where}: expected an instruction, ep_meta['lang'], got none")
    return words
