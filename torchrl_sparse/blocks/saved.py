"""Planners from files: each file says in its ``format`` what it holds, and one table says which class reads that.

A planner of one's own that is kept in a file writes JSON with a ``format`` of its own and adds a line::

    PLANNERS["my_package.mine/1"] = Mine  # read by Mine.from_pretrained(path)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torchrl_sparse.blocks import schedule
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag import planner as sag
from torchrl_sparse.storage.json import read_json

__all__ = ["PLANNERS", "load_planner"]

PLANNERS: dict[str, type[Planner]] = {
    schedule.FORMAT: schedule.SchedulePlanner,
    sag.FORMAT: sag.SAGPruner,
}
"""Format of a planner's file -> the class whose ``from_pretrained`` reads it."""


def load_planner(path: str | os.PathLike) -> Planner:
    """Read a planner of any format. Nothing in its files is executed.

    Args:
        path: a JSON file, or a folder whose ``config.json`` names the format.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, if its format is not in :data:`PLANNERS`, or as the planner's class raises it.

    Examples:
        >>> type(load_planner("assets/lift/bac.json")).__name__, type(load_planner("assets/lift/sag")).__name__
        ('SchedulePlanner', 'SAGPruner')
    """
    path = Path(path)
    file = path / "config.json" if path.is_dir() else path
    found = read_json(file, dict[str, Any]).get("format")
    if not isinstance(found, str) or found not in PLANNERS:
        raise ValueError(f"{file}: format: expected one of {list(PLANNERS)}, got {found!r}")
    return PLANNERS[found].from_pretrained(path)
