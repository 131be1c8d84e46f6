"""Checkpoints for resuming a training run."""

from __future__ import annotations

from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import describe_differences

__all__ = ["read_checkpoint", "write_checkpoint"]


def write_checkpoint(path: str | Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically: a kill leaves the old file or the new one."""
    with atomic_path(path) as temporary:
        torch.save(dict(state), temporary)


def read_checkpoint(
    path: str | Path,
    fields: Set[str],
    header: Mapping[str, Mapping[str, Any]],
    *,
    optional: Set[str] = frozenset(),
    free: Set[str] = frozenset(),
) -> dict[str, Any]:
    """Read a checkpoint. Nothing in the file is executed.

    Args:
        path: the file.
        fields: names of everything that it may hold.
        header: the fields that must be equal: how the training was set up.
        optional: the fields that may be missing.
        free: keys within ``header``'s fields that may differ.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming the file, what was expected and what came.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        # torch reports damaged and unsafe files through many exception types, and advises to run what is in them.
        raise InputError(
            f"{path}: expected a training checkpoint, got a file that torch cannot read: {str(error).partition('. ')[0]}"
        ) from error
    if not isinstance(state, dict) or not fields - optional <= set(state) <= fields:
        found = sorted(state) if isinstance(state, dict) else type(state).__name__
        raise InputError(
            f"{path}: expected a training checkpoint of this version with {sorted(fields)}, got {found}; "
            f"move it away to begin again"
        )
    for name, expected in header.items():
        stored, asked = (_without(free, values) for values in (state[name], expected))
        if differing := describe_differences(stored, asked):
            raise InputError(
                f"{path}: made with another {name}: {differing}; choose another out or move it away"
            )
    return state


def _without(keys: Set[str], values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in keys}
