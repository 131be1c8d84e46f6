"""Tensors in safetensors files, and checks that they are those that a module needs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["check_finite", "check_shapes", "check_tensors", "read_tensors", "take", "write_tensors"]

T = TypeVar("T")


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write a safetensors file, in one piece or not at all."""
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, temporary)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read all tensors of a safetensors file.

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
    """Remove the entries under ``prefix`` and return them without it.

    >>> tensors = {"model.a": 1, "b": 2}
    >>> take(tensors, "model."), tensors
    ({'a': 1}, {'b': 2})
    """
    names = [name for name in tensors if name.startswith(prefix)]
    return {name.removeprefix(prefix): tensors.pop(name) for name in names}


def check_shapes(where: str, found: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError, beginning with ``where``, unless ``found`` has exactly the names and shapes ``expected``."""
    missing, extra = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or extra:
        raise ValueError(f"{where}: tensors: missing {missing}, unexpected {extra}")
    for name, shape in expected.items():
        if tuple(found[name].shape) != tuple(shape):
            raise ValueError(
                f"{where}: {name}: expected shape {tuple(shape)}, got {tuple(found[name].shape)}"
            )


def check_finite(where: str, tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError, beginning with ``where``, if a tensor holds NaN or infinity."""
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise ValueError(f"{where}: {name}: expected finite numbers, got NaN or infinity")


def check_tensors(where: str, found: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Do what `check_shapes` and `check_finite` do."""
    check_shapes(where, found, expected)
    check_finite(where, found)
