"""Folder of finished parts beside a file under construction, so that interrupted work resumes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import describe_differences, read_json, write_json

__all__ = ["check_same", "claim_parts", "parts_of"]


def parts_of(path: Path) -> Path:
    """Return the folder for the parts of a file.

    >>> parts_of(Path("data/lift.h5")).name
    'lift.h5.parts'
    """
    return path.with_name(path.name + ".parts")


def claim_parts(path: Path, settings: Mapping[str, Any]) -> Path:
    """Create or reuse the folder of parts of ``path`` for these settings; an empty one is taken over.

    Raises:
        InputError: if it holds parts that were made with other settings.
    """
    parts = parts_of(path)
    parts.mkdir(parents=True, exist_ok=True)
    note = parts / "settings.json"
    if not any(parts.glob("[!.]*.h5")):
        write_json(note, settings)
    check_same(note, read_json(note, dict[str, Any]), settings)
    return parts


def check_same(where: Path, found: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise InputError unless ``where`` was made with these settings."""
    asked_of_it = {key: found[key] for key in asked if key in found}
    if differing := describe_differences(asked_of_it, asked):
        raise InputError(
            f"{where}: made with other settings: {differing}; choose another out or move it away"
        )
