"""Train a diffusion policy from demonstrations.

Stop it at any moment; the same command resumes it, equal to the last bit.

    python recipes/train_policy.py demos=data/lift_proficient.h5 out=runs/lift max_steps=20000 batch_size=128

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for `DiffusionPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.options import given
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.for_policy import contract_demos
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.envs.contract import policy_contract, task_contract
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.begun import continued_policy
from torchrl_sparse.training.diffusion.published import executed_steps, with_published
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer
from torchrl_sparse.training.diffusion.untrained import untrained_policy
from torchrl_sparse.training.loop import train


@recipe("train_policy")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    trainer = make_trainer(config)
    train(
        trainer,
        OmegaConf.to_container(config, resolve=True),
        export=partial(export, trainer, config),
        evaluate=partial(closed_loop_success, trainer, config),
    )


def make_trainer(config: DictConfig) -> PolicyTrainer:
    """Read the demonstrations and build a trainer; options that ``config`` left open are filled in."""
    task, cameras = find_task(config.task), chosen_cameras(config.cameras)
    begun = None
    if config.init is not None:
        asked = {"state_mode": config.state_normalization, **config.vision}
        begun = continued_policy(config.init, task.name, cameras, config.network, **asked)
    if not cameras and (seen := given(config.vision)):
        raise InputError(f"vision: expected null without cameras, got {seen}")
    source, train = begun.source if begun else {}, config.train
    train.n_action_steps = executed_steps(task.name, source, train.n_action_steps)
    config.train = with_published(task.name, train)
    contract = task_contract(task.name, cameras) if begun is None else policy_contract(task.name, begun)
    demos = contract_demos(
        config.demos, contract, filter_key=config.filter_key, image_folder=Path(config.out) / "images"
    )
    if begun is None:
        policy = untrained_policy(
            demos,
            given(with_published(task.name, config.network)),
            state_mode=config.state_normalization,
            poses=task.acts_in_poses,
            cameras=[*cameras],
            **given(config.vision),
            seed=config.seed,
        )
        policy.source = {"task": task.alias, "cameras": cameras} if cameras else {}
    else:
        policy = begun
    config.network = {name: policy.network.config[name] for name in config.network}
    config.vision = {"crop": 0.905, "width": 64, **given(config.vision)}
    if train.n_action_steps != executed_steps(task.name, policy.source):  # what whoever plays it takes
        policy.source = policy.source | {"n_action_steps": train.n_action_steps}
    trainer = PolicyTrainer(policy.to(config.device), demos, TrainConfig(**config.train))
    size = sum(p.numel() for p in policy.network.parameters())
    data = f"{len(demos)} demonstrations, {len(demos.data)} steps, {len(trainer.train_rows)} training windows"
    print(f"{config.demos}: {data}; {size:,} parameters")
    return trainer


def export(trainer: PolicyTrainer, config: DictConfig) -> Path:
    path = Path(config.out) / "policy"
    trainer.ema_policy().save_pretrained(path)
    return path


def closed_loop_success(trainer: PolicyTrainer, config: DictConfig) -> float | None:
    """Return the success rate of the averaged weights on development episodes; None without robosuite."""
    if importlib.util.find_spec("robosuite") is None:
        return None
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.envs.for_policy import diffusion_env
    from torchrl_sparse.evaluation.rollouts.evaluate import evaluate, success_rate

    policy = trainer.ema_policy()
    if config.eval_ddim_steps:
        policy.sampler = policy.sampler.variant("ddim", config.eval_ddim_steps)
    episodes = evaluate(
        "dense",
        ChunkExecutor(policy, trainer.config.n_action_steps),
        diffusion_env(config.task, policy),
        tuning_seeds(DEVELOPMENT_SEED, config.eval_episodes),
        num_envs=min(5, config.eval_episodes),
        policy_device=config.device,
    )
    return success_rate(episodes)


if __name__ == "__main__":
    main()
