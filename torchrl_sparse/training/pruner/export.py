"""Export of trained gates as planners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.training.pruner.trainer import PrunerTrainer

__all__ = ["export_planner", "exported"]


def export_planner(trainer: PrunerTrainer, folder: str | Path, settings: Mapping[str, Any]) -> Path:
    """Write the planner from the training so far and return its path.

    The planner is a cache schedule for static gates, ``l2c.json``, or ``l2c_noise.json`` with Learning-to-Cache's own
    objective. For gates that read the observation it is a folder ``pruner`` for `SAGPruner.from_pretrained`, with the schedule
    of their mean mask, the ablation, beside it: ``fixed.json``.

    Args:
        trainer: the gates, and what they were trained for.
        folder: where to write.
        settings: how they were trained, beside the trainer's configuration; for people and reports.
    """
    folder, config, policy = Path(folder), trainer.config, trainer.policy
    settings = {**asdict(config), **settings, "updates": trainer.step}
    is_static = trainer.gates.is_static
    static_name = "l2c_noise" if config.objective == "noise" else "l2c"
    schedule = CacheSchedule.from_mask(
        trainer.fixed_mask(),
        method=static_name if is_static else "sag_fixed",
        policy=policy.fingerprint,
        sampler=policy.sampler.name,
        reuse=config.reuse,
        settings=settings,
        block_types=policy.network.block_types,
    )
    if is_static:
        path = folder / f"{static_name}.json"
        schedule.save_pretrained(path)
        return path
    schedule.save_pretrained(folder / "fixed.json")
    info = PrunerInfo(
        policy=policy.fingerprint,
        sampler=policy.sampler.name,
        rate=config.rate,
        rate_range=config.rate_range,
        reuse=config.reuse,
        settings=settings,
        block_types=policy.network.block_types,
    )
    SAGPruner(trainer.gates, info).save_pretrained(folder / "pruner")
    return folder / "pruner"


def exported(folder: str | Path) -> list[str]:
    """Return the names by which a benchmark finds planners that `export_planner` wrote into ``folder``.

    >>> exported("assets/lift")
    ['l2c', 'l2c_noise']
    """
    names = ("pruner", "fixed.json", "l2c.json", "l2c_noise.json")
    return [Path(name).stem for name in names if (Path(folder) / name).exists()]
