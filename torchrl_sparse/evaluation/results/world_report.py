"""``world.json``: what steps and resets of simulated tasks take, and how far they are from the physics alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.storage.json import read_json

__all__ = ["WorldProfile", "WorldTimes", "format_world_profile", "load_world_profile", "world_rows"]


@dataclass(frozen=True)
class WorldTimes:
    """Seconds of one task: of the process, medians.

    Attributes:
        physics_s: of a control step's substeps in MuJoCo alone.
        python_step_s: of a collector's step with robosuite's own substeps and models, its share of resets included.
        compiled_step_s: the same, compiled.
        python_reset_s, compiled_reset_s: of a reset.
    """

    physics_s: float
    python_step_s: float
    compiled_step_s: float
    python_reset_s: float
    compiled_reset_s: float


@dataclass(frozen=True)
class WorldProfile:
    """The content of a ``world.json``.

    Attributes:
        machine: that was measured on.
        steps: of an episode.
        tasks: alias -> its times.
    """

    format: Literal["world/1"]
    machine: Machine
    steps: int
    tasks: dict[str, WorldTimes]


def format_world_profile(found: WorldProfile) -> str:
    """Return a table in Markdown below the line that says what it is."""
    told = f"Steps through a collector, one reset every {found.steps} of them, no policy; {found.machine.cpu}, process time."
    return f"{told}\n\n{markdown_table(world_rows(found))}"


def world_rows(found: WorldProfile) -> list[dict[str, str]]:
    """Return a row per task, column -> text."""
    return [
        {
            "simulated task": task,
            "steps/s, in Python": f"{1 / times.python_step_s:.0f}",
            "steps/s, compiled": f"{1 / times.compiled_step_s:.0f}",
            "ratio": f"{times.python_step_s / times.compiled_step_s:.2f}",
            "steps/s, physics alone": f"{1 / times.physics_s:.0f}",
            "reset, in Python, ms": f"{1e3 * times.python_reset_s:.0f}",
            "reset, compiled, ms": f"{1e3 * times.compiled_reset_s:.0f}",
        }
        for task, times in found.tasks.items()
    ]


def load_world_profile(path: str | Path) -> WorldProfile:
    """Read a ``world.json``.

    Raises:
        FileNotFoundError: if it is not there.
        InputError: if it is of another version or not as `WorldProfile` says.
    """
    return read_json(path, WorldProfile)
