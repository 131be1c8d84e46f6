"""The learned candidate of an acceleration: a SAG pruner of the policy's own sampler."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from torchrl_sparse.blocks.sag.planner import SAGPruner
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.diffusion.targets import load_targets, make_targets, save_targets
from torchrl_sparse.training.loop import train
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.export import export_planner
from torchrl_sparse.training.pruner.gates import make_gates
from torchrl_sparse.training.pruner.trainer import PrunerTrainer

__all__ = ["train_candidate"]

NAME = "sag"
_LOG = {"logger": "csv", "wandb_mode": "disabled", "log_every": 5, "checkpoint_every": 20}


def train_candidate(
    policy: DiffusionPolicy,
    demos: Demonstrations,
    config: PrunerConfig,
    folder: Path,
    planners: Path,
    *,
    made_for: Mapping[str, Any],
    n_action_steps: int = 8,
    share: float = 0.05,
) -> str:
    """Train the pruner, resuming an interrupted training, save it in ``planners``, and return its name there.

    Args:
        policy: the trained policy with its own sampler.
        demos: which its targets, the dense policy's answers, are made on.
        config: how to train.
        folder: of the checkpoint, the targets and the log.
        planners: where the finished pruner goes.
        made_for: what the targets are of; JSON values.
        n_action_steps: actions executed of a chunk.
        share: of the demonstrations' windows, see `make_targets`.

    Raises:
        RunFailed: if a signal stopped it; called again it goes on.
        InputError: if the folder holds another training.
    """
    path, made_for = folder / "targets.safetensors", {**made_for, "share": share}
    if not path.exists():
        with progress("targets", "window") as show:
            targets = make_targets(
                policy,
                demos,
                share=share,
                n_action_steps=n_action_steps,
                seed=config.seed,
                on_progress=show,
            )
        save_targets(path, targets, made_for)
    gates = make_gates(NAME, policy, rate_input=config.rate_range is not None, seed=config.seed)
    trainer = PrunerTrainer(gates, policy, load_targets(path, made_for), config)
    train(
        trainer,
        {**_LOG, "out": str(folder)},
        export=partial(export_planner, trainer, folder, {"share": share}),
    )
    if trainer.step < trainer.total:
        raise RunFailed(f"{folder}: stopped at step {trainer.step} of {trainer.total}; run again to resume")
    SAGPruner.from_pretrained(folder / "pruner").save_pretrained(planners / NAME)
    return NAME
