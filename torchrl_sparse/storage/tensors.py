"""Tensors in safetensors files, with checks of names, shapes and values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.atomic import atomic_path

__all__ = [
    "check_folder",
    "check_finite",
    "check_shapes",
    "read_tensors",
    "shapes_of",
    "take",
    "write_tensors",
]

T = TypeVar("T")
# safetensors' names of the types that weights are kept in, and flags
_NUMBERS, _FLAGS = ("F16", "BF16", "F32", "F64"), ("BOOL",)
_NAMED = 5  # wrong tensors that an error lists


def write_tensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write a safetensors file atomically."""
    with atomic_path(path) as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, temporary)


def read_tensors(path: Path, expected: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
    """Read all tensors of a safetensors file, after comparing names, shapes and types.

    Args:
        path: the file.
        expected: names, shapes and kinds of number that it must hold, such as the state of a module on the meta device;
            any floating-point tensors by default.

    Raises:
        FileNotFoundError: if it is not there.
        InputError: naming the file, if it is damaged or holds anything else, or a number that is not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"expected a file {path}, got none")
    try:
        with safe_open(path, "pt") as file:
            names = file.keys()
            _check_header(path, {name: file.get_slice(name) for name in names}, expected)
            tensors = {name: file.get_tensor(name) for name in names}
    except SafetensorError as error:
        raise InputError(f"{path}: expected a complete safetensors file, got: {error}") from error
    check_finite(str(path), tensors)
    return tensors


def _check_header(path: Path, found: Mapping[str, Any], expected: Mapping[str, Tensor] | None) -> None:
    if expected is not None:
        shapes = {name: tuple(part.get_shape()) for name, part in found.items()}
        check_shapes(str(path), shapes, shapes_of(expected))
    for name, part in found.items():
        types = _FLAGS if expected is not None and expected[name].dtype == torch.bool else _NUMBERS
        if part.get_dtype() not in types:
            raise InputError(f"{path}: {name}: expected a type of {list(types)}, got {part.get_dtype()}")


def take(tensors: dict[str, T], prefix: str) -> dict[str, T]:
    """Remove the entries under ``prefix`` and return them without the prefix.

    >>> tensors = {"model.a": 1, "b": 2}
    >>> take(tensors, "model."), tensors
    ({'a': 1}, {'b': 2})
    """
    names = [name for name in tensors if name.startswith(prefix)]
    return {name.removeprefix(prefix): tensors.pop(name) for name in names}


def shapes_of(tensors: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of named tensors, or of other values with a shape."""
    return {name: tuple(value.shape) for name, value in tensors.items()}


def check_shapes(
    where: str, found: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise InputError, starting with ``where``, unless ``found`` has exactly the names and shapes ``expected``.

    >>> check_shapes("a.safetensors", {"w": (2, 3)}, {"w": (2, 4)})
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: a.safetensors: w: expected shape (2, 4), got (2, 3)
    """
    missing, extra = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or extra:
        raise InputError(f"{where}: tensors: missing {_first(missing)}, unexpected {_first(extra)}")
    for name, shape in expected.items():
        if found[name] != shape:
            raise InputError(f"{where}: {name}: expected shape {shape}, got {found[name]}")


def _first(names: list[str]) -> str:
    more = len(names) - _NAMED
    return f"{names[:_NAMED]}" + (f" and {more} more" if more > 0 else "")


def check_finite(where: str, tensors: Mapping[str, Tensor]) -> None:
    """Raise InputError, starting with ``where``, if a tensor holds NaN or infinity."""
    for name, value in tensors.items():
        if not value.isfinite().all():
            raise InputError(f"{where}: {name}: expected finite numbers, got NaN or infinity")


def check_folder(path: Path) -> None:
    """Raise FileNotFoundError unless a saved policy's folder exists."""
    if not path.is_dir():
        raise FileNotFoundError(
            f"policy: expected a folder that holds config.json, or a .ckpt file, got {path}; names of a hub are not looked up"
        )
