"""``world.json``: what steps and resets of simulated tasks take, and how far they are from the physics alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.tables import markdown_table

__all__ = ["WorldProfile", "WorldTimes", "format_world_profile"]


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
    rows = [
        {
            "task": task,
            "steps/s, Python": f"{1 / times.python_step_s:.0f}",
            "compiled": f"{1 / times.compiled_step_s:.0f}",
            "ratio": f"{times.python_step_s / times.compiled_step_s:.2f}",
            "physics alone": f"{1 / times.physics_s:.0f}",
            "reset, Python, ms": f"{1e3 * times.python_reset_s:.0f}",
            "kept model, ms": f"{1e3 * times.compiled_reset_s:.0f}",
        }
        for task, times in found.tasks.items()
    ]
    told = f"Steps through a collector, one reset every {found.steps} of them, no policy; {found.machine.cpu}, process time."
    return f"{told}\n\n{markdown_table(rows)}"
