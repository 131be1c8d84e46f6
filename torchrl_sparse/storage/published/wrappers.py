"""Removal of wrapper prefixes from the names of saved weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from torchrl_sparse.errors import InputError

__all__ = ["without_wrappers"]

T = TypeVar("T")
_WRAPPERS = frozenset({"module", "_orig_mod", "_fsdp_wrapped_module", "_checkpoint_wrapped_module"})
"""What DistributedDataParallel, AveragedModel, torch.compile, FSDP and checkpointing call the module that they hold."""


def without_wrappers(where: str, tensors: Mapping[str, T]) -> dict[str, T]:
    """Return ``tensors`` with wrapper names removed from their names, at any depth.

    Raises:
        InputError: if two would have one name.

    >>> without_wrappers("model", {"module.head.weight": 1, "encoder._orig_mod.bias": 2})
    {'head.weight': 1, 'encoder.bias': 2}
    """
    renamed: dict[str, T] = {}
    for name, value in tensors.items():
        plain = ".".join(part for part in name.split(".") if part not in _WRAPPERS)
        if plain in renamed:
            raise InputError(
                f"{where}: expected one tensor {plain}, got one of a wrapped module, {name}, too"
            )
        renamed[plain] = value
    return renamed
