"""JSON and safetensors files of policies and pruners, read with checks. Neither can hold code."""

from __future__ import annotations

import json
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["read_config", "read_json", "read_tensors", "write_config", "write_tensors"]


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
