"""Train a diffusion policy. Stop it at any moment; the same command resumes it, equal to the last bit.

    python recipes/train_policy.py demos=data/lift_proficient.h5 out=runs/lift max_steps=20000 batch_size=128

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for `DiffusionPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.published import with_published
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
    """Read the demonstrations and build what is trained on them; ``config`` then holds what it had left open."""
    config.network = with_published(config.task, config.network)
    config.train = with_published(config.task, config.train)
    task, cameras = find_task(config.task), chosen_cameras(config.cameras)
    demos = read_demos(
        config.demos,
        task.proprioception_keys if cameras else task.state_keys,
        filter_key=config.filter_key,
        cameras=cameras,
        image_folder=Path(config.out) / "images",
        poses=task.acts_in_poses,
        task=task.name,
    )
    if config.init is None:
        policy = untrained_policy(
            demos,
            config.network,
            state_mode=config.state_normalization,
            poses=task.acts_in_poses,
            cameras=[*cameras],
            **config.vision,
            seed=config.seed,
        )
    else:
        policy = DiffusionPolicy.from_pretrained(config.init, engine="reference")
    policy.to(config.device)
    trainer = PolicyTrainer(
        policy.network, policy.normalizer, demos, TrainConfig(**config.train), policy.vision
    )
    print(
        f"{config.demos}: {len(demos)} demonstrations, {len(demos.data)} steps, "
        f"{len(trainer.train_rows)} training windows; "
        f"{sum(p.numel() for p in policy.network.parameters()):,} parameters"
    )
    return trainer


def export(trainer: PolicyTrainer, config: DictConfig) -> Path:
    path = Path(config.out) / "policy"
    averaged_policy(trainer, config).save_pretrained(path)
    return path


def averaged_policy(
    trainer: PolicyTrainer, config: DictConfig, sampler: Sampler | None = None
) -> DiffusionPolicy:
    """Return the policy with averaged weights and a note of its cameras, for whoever makes an environment for it."""
    policy = trainer.ema_policy(sampler)
    if cameras := chosen_cameras(config.cameras):
        policy.source = {"task": find_task(config.task).alias, "cameras": cameras}
    return policy


def closed_loop_success(trainer: PolicyTrainer, config: DictConfig) -> float | None:
    """Return the success rate of the averaged weights on development episodes; None without robosuite."""
    if importlib.util.find_spec("robosuite") is None:
        return None
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.envs.for_policy import diffusion_env
    from torchrl_sparse.evaluation.rollouts.evaluate import evaluate, success_rate

    sampler = Sampler("ddim", config.eval_ddim_steps) if config.eval_ddim_steps else Sampler()
    policy = averaged_policy(trainer, config, sampler)
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
