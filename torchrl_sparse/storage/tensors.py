"""Checks that a file's tensors are those that a module needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from torch import Tensor

__all__ = ["check_finite", "check_shapes", "check_tensors", "take"]

T = TypeVar("T")


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


def check_tensors(where: str, found: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]) -> None:
    """:func:`check_shapes` and :func:`check_finite`."""
    check_shapes(where, found, expected)
    check_finite(where, found)
