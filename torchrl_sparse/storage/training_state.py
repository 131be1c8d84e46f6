"""Checkpoints that a training goes on from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

__all__ = ["read_checkpoint"]


def read_checkpoint(path: str | Path, fields: set[str], header: dict[str, dict]) -> dict[str, Any]:
    """What a trainer saved. Nothing in the file is executed.

    Args:
        path: the file.
        fields: names of everything that it must hold.
        header: those that must be equal, since a training can only go on as it was begun.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: naming the file, what was expected and what came.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        # torch reports damaged and unsafe files through many exception types.
        raise ValueError(
            f"{path}: expected a training checkpoint, got a file that torch cannot read: {error}"
        ) from error
    if not isinstance(state, dict) or set(state) != fields:
        found = sorted(state) if isinstance(state, dict) else type(state).__name__
        raise ValueError(f"{path}: expected a training checkpoint with {sorted(fields)}, got {found}")
    for name, expected in header.items():
        if state[name] != expected:
            raise ValueError(f"{path}: made with another {name}: {_difference(expected, state[name])}")
    return state


def _difference(expected: dict, found: dict) -> str:
    names = [name for name in {**expected, **found} if expected.get(name) != found.get(name)]
    return ", ".join(f"{name} is {expected.get(name)!r} here and {found.get(name)!r} there" for name in names)
