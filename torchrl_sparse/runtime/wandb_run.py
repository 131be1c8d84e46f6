"""Weights & Biases run of a recipe, resumed under the same id whenever the recipe is restarted."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["wandb_arguments"]

_NOTE = "wandb_run_id"


def wandb_arguments(settings: Mapping[str, Any], folder: str | Path, name: str) -> dict[str, Any]:
    """Return arguments of ``wandb.init``; the run id is saved in ``folder`` so that the next call resumes the run.

    Offline, W&B begins another folder of the same id, and its own count of steps at 0: lines are logged with their step.
    W&B's own variables count before: ``WANDB_RUN_ID``, which its agents set, and ``WANDB_DIR``.

    Args:
        settings: of a recipe, all of which the run is given; its section ``wandb`` has ``project``, ``entity``, ``group``,
            ``name``, ``tags`` and ``mode``, None for W&B's choice.
        folder: of the recipe's output, where W&B keeps its files unless ``WANDB_DIR`` says otherwise.
        name: of the run where the section has none.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     made = [wandb_arguments({"wandb": {"group": "a"}}, folder, "lift bac") for _ in range(2)]
    >>> made[0]["id"] == made[1]["id"], made[0]["name"], made[0]["group"]
    (True, 'lift bac', 'a')
    """
    folder = Path(folder)
    chosen = {key: value for key, value in settings["wandb"].items() if value not in (None, [])}
    kept = {"id": os.environ.get("WANDB_RUN_ID") or _noted_id(folder), "resume": "allow"}
    place = {"dir": os.environ.get("WANDB_DIR") or str(folder.resolve())}
    return {"name": name, **chosen, **kept, **place, "config": dict(settings)}


def _noted_id(folder: Path) -> str:
    note = folder / _NOTE
    if not note.exists():
        folder.mkdir(parents=True, exist_ok=True)
        note.write_text(secrets.token_hex(4))
    return note.read_text().strip()
