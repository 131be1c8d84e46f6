"""A folder of finished parts beside a file in the making, so that long work goes on where a kill stopped it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["check_same", "claim_parts", "parts_of"]


def parts_of(path: Path) -> Path:
    """Return the folder of parts of a file.

    >>> parts_of(Path("data/lift.h5")).name
    'lift.h5.parts'
    """
    return path.with_name(path.name + ".parts")


def claim_parts(path: Path, settings: Mapping[str, Any]) -> Path:
    """Make the folder of parts of ``path``, or find it again for the same settings.

    Raises:
        ValueError: if it holds parts that were made with other settings.
    """
    parts = parts_of(path)
    parts.mkdir(parents=True, exist_ok=True)
    note = parts / "settings.json"
    if not note.exists():
        with atomic_path(note) as temporary:
            temporary.write_text(json.dumps(settings, indent=1))
    check_same(note, json.loads(note.read_text()), settings)
    return parts


def check_same(where: Path, found: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise ValueError unless ``where`` was made with the settings asked for."""
    different = [
        f"{key} is {found.get(key)!r}, not {asked[key]!r}" for key in asked if found.get(key) != asked[key]
    ]
    if different:
        raise ValueError(
            f"{where} was made with other settings ({'; '.join(different)}): move it or choose another file"
        )
