"""Checks of sizes from a file or a caller, before memory is allocated for them."""

from __future__ import annotations

import reprlib
from typing import Any

from torchrl_sparse.errors import InputError

__all__ = ["check_size"]


def check_size(name: str, value: Any, most: int, least: int = 1) -> None:
    """Raise InputError unless ``value`` is an integer from ``least`` to ``most``.

    A network's ``most`` lies far beyond any use. It bounds what a configuration can take before its weights are seen.

    >>> check_size("n_layer", 10**12, 256)
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: n_layer: expected a whole number from 1 to 256, got 1000000000000
    """
    if type(value) is not int or not least <= value <= most:
        raise InputError(f"{name}: expected a whole number from {least} to {most}, got {reprlib.repr(value)}")
