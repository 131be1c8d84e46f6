"""Planners from files: each file's ``format`` names its content, and one table maps formats to classes.

A planner of one's own that is kept in a file writes JSON with a ``format`` of its own and adds a line::

    PLANNERS["my_package.mine/1"] = Mine  # read by Mine.from_pretrained(path)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.blocks import schedule
from torchrl_sparse.blocks.planner import Dense, Planner, PlanSpec, StaticPlanner
from torchrl_sparse.blocks.sag import planner as sag
from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import read_json

__all__ = ["PLANNERS", "load_planner", "save_beside", "saved_planners"]

PLANNERS: dict[str, type[Planner]] = {
    schedule.FORMAT: schedule.SchedulePlanner,
    sag.FORMAT: sag.SAGPruner,
}
"""Format of a planner's file -> the class whose ``from_pretrained`` reads it."""

_REMOVED = ("torchrl_sparse.recall/1", "torchrl_sparse.tts/1")  # reused features of earlier policy calls


def load_planner(path: str | os.PathLike, spec: PlanSpec | None = None) -> Planner:
    """Read a planner of any format. Nothing in its files is executed.

    Args:
        path: a JSON file, or a folder whose ``config.json`` names the format.
        spec: what the planner is to serve; it comes bound to that. None leaves it open.

    Raises:
        FileNotFoundError: if there is no such file.
        InputError: naming the file, if its format is not in :data:`PLANNERS` or it was made for another spec, or as the
            planner's class raises it.

    Examples:
        >>> type(load_planner("assets/lift/bac.json")).__name__, type(load_planner("assets/lift/sag")).__name__
        ('SchedulePlanner', 'SAGPruner')
    """
    path = Path(path)
    file = path / "config.json" if path.is_dir() else path
    found = read_json(file, dict[str, Any]).get("format")
    if found in _REMOVED:
        raise InputError(
            f"{file}: format: {found!r} reuses features of earlier policy calls, which this version cannot run; "
            f"expected one of {list(PLANNERS)}"
        )
    if not isinstance(found, str) or found not in PLANNERS:
        raise InputError(f"{file}: format: expected one of {list(PLANNERS)}, got {found!r}")
    planner = PLANNERS[found].from_pretrained(path)
    if spec is not None:
        try:
            planner.bind(spec)
        except ValueError as error:
            raise InputError(f"{file}: {error}") from error
    return planner


def saved_planners(folder: str | os.PathLike) -> list[str]:
    """Return the names of the planners in a folder, sorted: ``NAME.json`` or ``NAME/`` with a format in :data:`PLANNERS`.

    >>> saved_planners("assets/lift")[4:]
    ['bac_unified', 'l2c', 'l2c_noise', 'sag', 'sag_fixed', 'searched']
    """
    files = {path.stem: path for path in Path(folder).glob("*.json")}
    files |= {path.parent.name: path for path in Path(folder).glob("*/config.json")}
    return sorted(name for name, file in files.items() if _format(file) in PLANNERS)


def _format(file: Path) -> str | None:
    """Return the format that a file names; None if it is no JSON object that names one."""
    try:
        found = read_json(file, dict[str, Any]).get("format")
    except ValueError:
        return None
    return found if isinstance(found, str) else None


def save_beside(planner: Planner, folder: Path) -> Literal["plan.json", "plan"] | None:
    """Write a bound planner into its policy's folder and return its name there, for `load_planner`; None for dense.

    A learned planner is the folder ``plan``. One that prunes the same blocks always is ``plan.json``: a cache schedule,
    unless its class is in :data:`PLANNERS`.

    Raises:
        InputError: if the planner reads the observation and its class is not in the table; nothing is written.

    Examples:
        >>> import tempfile
        >>> from torchrl_sparse.blocks.uniform import Uniform
        >>> planner, folder = Uniform(2), Path(tempfile.mkdtemp())
        >>> planner.bind(PlanSpec(4, 1, "a policy"))
        >>> save_beside(planner, folder)
        'plan.json'
        >>> load_planner(folder / "plan.json").schedule.computed_steps
        ((0, 2), (0, 2), (0, 2))
    """
    if isinstance(planner, Dense):
        return None
    storable = _storable(planner)
    name: Literal["plan.json", "plan"] = "plan.json" if planner.is_static else "plan"
    storable.save_pretrained(folder / name)
    return name


def _storable(planner: Planner) -> Any:
    if type(planner) in PLANNERS.values():
        return planner
    if not isinstance(planner, StaticPlanner):
        raise InputError(
            f"plan: expected a planner of a class in PLANNERS or a StaticPlanner, to save it, got {type(planner).__name__}"
        )
    spec = planner.spec
    return schedule.CacheSchedule.from_mask(
        planner.mask(spec),
        method=type(planner).__name__,
        policy=spec.policy,
        sampler=spec.sampler,
        reuse=planner.reuse,
        block_types=spec.block_types,
    )
