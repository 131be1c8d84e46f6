"""JSON and safetensors files of policies and pruners, read with checks. Neither can hold code."""

from __future__ import annotations

import json
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_sparse.files import atomic_path

T = TypeVar("T")

__all__ = [
    "check_finite",
    "check_shapes",
    "check_tensors",
    "read_config",
    "read_json",
    "read_tensors",
    "take",
    "write_config",
    "write_tensors",
]


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Writes a safetensors file, in one piece or not at all."""
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, temporary)


def write_config(path: Path, config: Mapping[str, Any]) -> None:
    """Writes a JSON file, in one piece or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(config, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is not JSON.
    """
    if not path.is_file():
        raise FileNotFoundError(f"expected a file {path}, got none")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected a complete JSON file, got: {error}") from error


def read_config(
    path: Path, file_format: str, fields: set[str], optional: Set[str] = frozenset()
) -> dict[str, Any]:
    """The JSON object in ``path``, with exactly ``fields``, of which ``"format"`` is ``file_format``; fields that
    are ``optional`` may be there too.

    Raises:
        FileNotFoundError, ValueError: naming the file, what was expected and what came.
    """
    config = read_json(path)
    if not isinstance(config, dict) or config.get("format") != file_format:
        found = config.get("format") if isinstance(config, dict) else type(config).__name__
        raise ValueError(f"{path}: format: expected {file_format!r}, got {found!r}")
    if set(config) - optional != fields:
        raise ValueError(f"{path}: expected the fields {sorted(fields)}, got {sorted(config)}")
    return config


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file.

    Raises:
        FileNotFoundError: if it is not there.
        ValueError: if it is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"expected a file {path}, got none")
    try:
        return load_file(path)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{path}: expected a complete safetensors file, got: {error}") from error


def take(tensors: dict[str, T], prefix: str) -> dict[str, T]:
    """Removes the entries under ``prefix`` and returns them without it.

    >>> tensors = {"model.a": 1, "b": 2}
    >>> take(tensors, "model."), tensors
    ({'a': 1}, {'b': 2})
    """
    names = [name for name in tensors if name.startswith(prefix)]
    return {name.removeprefix(prefix): tensors.pop(name) for name in names}


def check_shapes(where: str, found: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raises ValueError, beginning with ``where``, unless ``found`` has exactly the names and shapes ``expected``."""
    missing, extra = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or extra:
        raise ValueError(f"{where}: tensors: missing {missing}, unexpected {extra}")
    for name, shape in expected.items():
        if tuple(found[name].shape) != tuple(shape):
            raise ValueError(
                f"{where}: {name}: expected shape {tuple(shape)}, got {tuple(found[name].shape)}"
            )


def check_finite(where: str, tensors: Mapping[str, Tensor]) -> None:
    """Raises ValueError, beginning with ``where``, if a tensor holds NaN or infinity."""
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise ValueError(f"{where}: {name}: expected finite numbers, got NaN or infinity")


def check_tensors(
    path: Path, prefix: str, found: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]
) -> None:
    """`check_shapes` and `check_finite` of the tensors under ``prefix`` of a file."""
    check_shapes(f"{path}: {prefix}", found, expected)
    check_finite(f"{path}: {prefix}", found)
