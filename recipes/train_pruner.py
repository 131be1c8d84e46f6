"""Train a pruner (SAG) or a static schedule for a policy.

    python recipes/train_pruner.py task=can policy=assets/can demos=data/can_proficient.h5 rate=0.91 out=runs/sag_can

``method=l2c reuse=block`` learns what needs no observation, with SAG's objective or, with ``objective=noise rate=0.45
train.norm=l2 targets.source=data``, L2C's own. Stop it at any moment; the same command resumes it, equal to the last bit.
`load_planner` reads ``pruner`` and its mean, ``fixed.json``.
"""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.cli.recipe import benchmark_command, recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.contract import policy_contract, provenance
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.training.curves import plot_pruner_curves, read_scalars
from torchrl_sparse.training.diffusion.targets import add_queries, load_targets, make_targets, save_targets
from torchrl_sparse.training.loop import CHECKPOINT, train
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.export import export_planner, exported
from torchrl_sparse.training.pruner.fit import fit_to_masks, spread_logits
from torchrl_sparse.training.pruner.gates import make_gates
from torchrl_sparse.training.pruner.rollouts import closed_loop_queries
from torchrl_sparse.training.pruner.trainer import PrunerTrainer


@recipe("train_pruner")
def main(config: DictConfig) -> None:
    torch.set_num_threads(config.threads or torch.get_num_threads())
    out, settings = Path(config.out), OmegaConf.to_container(config, resolve=True)
    masks = [CacheSchedule.from_pretrained(path).mask() for path in initial_schedules(config)]
    if config.spread and (masks or config.method == "l2c"):
        raise InputError(f"spread: expected null with an init or with method=l2c, got {config.spread}")
    trainer = make_trainer(config)
    if not (out / CHECKPOINT).exists():
        begin(trainer, masks, config)
    made = {name: settings[name] for name in ("targets", "spread", "rollouts")}
    made["init"] = initial_schedules(config)
    train(trainer, settings, export=partial(export_planner, trainer, out, made))
    if config.logger == "csv" and trainer.step >= config.log_every:
        plot_pruner_curves(read_scalars(out / "log"), out / "curves.png", rate=trainer.config.rate)
    print(f"held out: {trainer.validate()}")
    print(benchmark_command(config.task, config.policy, out, exported(out)))


def make_trainer(config: DictConfig) -> PrunerTrainer:
    """Read the policy and build a trainer for its gates."""
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    if config.sampler is not None:
        policy.sampler = policy.sampler.variant(**config.sampler)
    options = PrunerConfig(**OmegaConf.to_container(config.train, resolve=True))
    sizes = {**config.network, "rate_input": options.rate_range is not None}
    gates = make_gates(config.method, policy, seed=options.seed, **sizes)
    return PrunerTrainer(gates, policy, calibration_set(policy, config), options)


def initial_schedules(config: DictConfig) -> list[str]:
    return [config.init] if isinstance(config.init, str) else list(config.init or [])


def calibration_set(policy: DiffusionPolicy, config: DictConfig) -> TensorDict:
    """Return calibration observations and target actions, from an earlier run's file if there is one.

    A file with other settings is made again, or refused once gates were trained on it.
    """
    path = Path(config.out) / "targets.safetensors"
    made_for = {
        "policy": policy.fingerprint,
        **policy.sampler.config,
        **provenance(policy_contract(config.task, policy)),
        "demos": config.demos,
        **config.targets,
        "rollouts": [config.rollouts, *initial_schedules(config)[:1]] if config.rollouts else [],
    }
    stale = () if path.with_name(CHECKPOINT).exists() else (ValueError,)
    with suppress(FileNotFoundError, *stale):
        return load_targets(path, made_for).to(policy.device)
    demos = policy_demos(config.demos, config.task, policy)
    with progress("targets", "window") as show:
        targets = make_targets(policy, demos, **config.targets, on_progress=show)
    if config.rollouts:
        if (source := config.targets.source) != "teacher":
            raise InputError(f"targets.source: expected 'teacher' with rollouts, got {source!r}")
        queries = closed_loop_queries(policy, config.task, config.rollouts, *initial_schedules(config)[:1])
        with progress("targets", "query") as show:
            targets = add_queries(policy, targets, queries, seed=config.targets.seed, on_progress=show)
    save_targets(path, targets, made_for)
    return targets


def begin(trainer: PrunerTrainer, masks: list[Tensor], config: DictConfig) -> None:
    """Fit the gates to the masks of ``init``, or spread their logits; otherwise leave them as they are."""
    queries = trainer.train_set
    if config.spread:
        spread_logits(trainer.gates, queries, config.spread)
    if not masks:
        return
    with progress("fit to schedules", "step") as show:
        fit_to_masks(trainer.gates, masks, queries, seed=trainer.config.seed, on_progress=show)
    print(f"{', '.join(initial_schedules(config))}: fitted, {trainer.validate()}")


if __name__ == "__main__":
    main()
