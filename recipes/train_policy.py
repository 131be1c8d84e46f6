"""Trains a diffusion policy. Stop it at any moment; the same command goes on, equal to the last bit.

    python recipes/train_policy.py demos=data/lift_proficient.h5 out=runs/lift max_steps=20000 batch_size=128

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for
`DiffusionPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_sparse import keys
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.data.robomimic import Demonstrations, read_demos
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import published_shape
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer
from torchrl_sparse.training.loop import train
from torchrl_sparse.training.trainer import TrainConfig


@hydra.main(version_base=None, config_path=".", config_name="train_policy")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    trainer = make_trainer(config)
    settings = OmegaConf.to_container(config, resolve=True)
    train(
        trainer,
        settings,
        save=partial(save, trainer, config),
        evaluate=partial(closed_loop_success, trainer, config),
    )


def as_published(config: DictConfig) -> None:
    """Fills in what is left open with the published choices for the task."""
    shape = asdict(published_shape(config.task))
    for section in (config.network, config.train):
        for name in section.keys() & shape.keys():
            if section[name] is None:
                section[name] = shape[name]
    if config.state_normalization is None:
        config.state_normalization = "global" if find_task(config.task).acts_in_poses else "range"


def make_trainer(config: DictConfig) -> PolicyTrainer:
    """Reads the demonstrations and builds what is trained on them; ``config`` then holds what it had left open."""
    as_published(config)
    task, cameras = find_task(config.task), chosen_cameras(config.cameras)
    demos = read_demos(
        config.demos,
        task.proprioception_keys if cameras else task.state_keys,
        filter_key=config.filter_key,
        cameras=cameras,
        image_folder=Path(config.out) / "images",
        poses=task.acts_in_poses,
    )
    if config.init is None:
        policy = untrained_policy(demos, cameras, config)
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


def untrained_policy(demos: Demonstrations, cameras: dict[str, str], config: DictConfig) -> DiffusionPolicy:
    """A network that fits the demonstrations."""
    state, action = demos.data[keys.STATE], demos.data[keys.ACTION]
    poses = find_task(config.task).acts_in_poses
    normalizer = Normalizer.fit(state, action, state_mode=config.state_normalization, poses=poses)
    torch.manual_seed(config.seed)
    vision = make_vision(demos, cameras, config) if cameras else None
    features = 0 if vision is None else vision.feature_dim
    network = TransformerForDiffusion(
        input_dim=action.shape[-1],
        output_dim=action.shape[-1],
        cond_dim=features + state.shape[-1],
        **config.network,
    )
    return DiffusionPolicy(network, normalizer, vision=vision, engine="reference")


def make_vision(demos: Demonstrations, cameras: dict[str, str], config: DictConfig) -> VisionEncoder:
    image_size = demos.data["observation", next(iter(cameras))].shape[-2:]
    crop_size = [round(config.vision.crop * size) for size in image_size]
    return VisionEncoder([*cameras], image_size=image_size, crop_size=crop_size, width=config.vision.width)


def save(trainer: PolicyTrainer, config: DictConfig) -> None:
    trainer.save(Path(config.out) / "checkpoint.pt")
    averaged_policy(trainer, config).save_pretrained(Path(config.out) / "policy")


def averaged_policy(
    trainer: PolicyTrainer, config: DictConfig, sampler: Sampler | None = None
) -> DiffusionPolicy:
    """With a note of the cameras, for whoever makes an environment for it."""
    policy = trainer.ema_policy(sampler)
    if cameras := chosen_cameras(config.cameras):
        policy.source = {"task": find_task(config.task).alias, "cameras": cameras}
    return policy


def closed_loop_success(trainer: PolicyTrainer, config: DictConfig) -> float | None:
    """Success rate of the averaged weights on episodes that no demonstration was made from; None without robosuite."""
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
        range(DEVELOPMENT_SEED, DEVELOPMENT_SEED + config.eval_episodes),
        num_envs=min(5, config.eval_episodes),
        policy_device=config.device,
    )
    return success_rate(episodes)


if __name__ == "__main__":
    main()
