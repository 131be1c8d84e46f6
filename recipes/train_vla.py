"""Trains a vision-language-action policy. Stop it at any moment; the same command goes on, equal to the last bit.

    python recipes/collect_demos.py task=lift_named episodes=600 out=data/lift_named_proficient.h5
    python recipes/render_demos.py task=lift_named
    python recipes/train_vla.py task=lift_named precision=bf16

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for `VLAPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.rotations import ABSOLUTE_DIM
from torchrl_sparse.training.loop import train
from torchrl_sparse.training.trainer import TrainConfig
from torchrl_sparse.training.vla.grounding import GroundingConfig, ObjectPositions
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations, VLATrainer

SIZES = {"tiny": VLAConfig.tiny, "small": VLAConfig.small, "published": VLAConfig}


@hydra.main(version_base=None, config_path=".", config_name="train_vla")
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


def make_trainer(config: DictConfig) -> VLATrainer:
    """Reads the demonstrations and builds a policy that fits them, or takes the one to start from."""
    episodes = read_demos(
        config.demos,
        find_robosuite_task(config.task).proprioception_keys,
        cameras=chosen_cameras(config.cameras),
        image_folder=Path(config.out) / "images",
    )
    lessons = GroundingConfig(**config.grounding)
    objects = None if lessons == GroundingConfig() else read_objects(config)
    demos = InstructedDemonstrations(episodes, read_instructions(config.demos), objects)
    policy = (
        untrained_policy(demos, config) if config.init is None else VLAPolicy.from_pretrained(config.init)
    )
    trainer = VLATrainer(policy.to(config.device), demos, TrainConfig(**config.train), lessons)
    print(
        f"{config.demos}: {len(episodes)} demonstrations of {len(set(demos.instructions))} instructions, "
        f"{len(episodes.data)} steps, {len(trainer.train_rows)} training windows; "
        f"{sum(p.numel() for p in policy.network.parameters()):,} parameters"
    )
    return trainer


def untrained_policy(demos: InstructedDemonstrations, config: DictConfig) -> VLAPolicy:
    """A network that fits the demonstrations, with random weights."""
    data = demos.episodes.data
    action = data[keys.ACTION]
    grippers = range(ABSOLUTE_DIM - 1, action.shape[-1], ABSOLUTE_DIM)
    words = sorted({word for text in demos.instructions for word in text.lower().split()})
    torch.manual_seed(config.seed)
    return VLAPolicy(
        VLANetwork(make_config(config, data)),
        QuantileNormalizer.fit(data[keys.STATE], action, gripper=grippers),
        WordTokenizer(words),
    )


def read_objects(config: DictConfig) -> ObjectPositions:
    """Where the objects are that the task's instructions name, in the order of these."""
    positions = read_demos(config.demos, ["object_positions"]).data[keys.STATE]
    return ObjectPositions(
        positions.unflatten(1, (-1, 3)), find_robosuite_task(config.task).instructions
    ).standardised()


def make_config(config: DictConfig, data: TensorDict) -> VLAConfig:
    """The size that was asked for, with what the demonstrations decide."""
    if config.size not in SIZES:
        raise ValueError(f"size: expected one of {', '.join(SIZES)}, got {config.size!r}")
    cameras = [["observation", name] for name in chosen_cameras(config.cameras)]
    decided = {
        "cameras": cameras,
        "image_size": data[tuple(cameras[0])].shape[-1],
        "state_dim": data[keys.STATE].shape[-1],
        "action_dim": data[keys.ACTION].shape[-1],
    }
    fields = OmegaConf.merge(SIZES[config.size]().to_dict(), config.network, decided)
    return VLAConfig.from_dict(OmegaConf.to_container(fields, resolve=True))


def save(trainer: VLATrainer, config: DictConfig) -> None:
    trainer.save(Path(config.out) / "checkpoint.pt")
    averaged_policy(trainer).save_pretrained(Path(config.out) / "policy")


def averaged_policy(trainer: VLATrainer) -> VLAPolicy:
    return VLAPolicy(trainer.averaged(), trainer.policy.normalizer, trainer.policy.tokenizer)


def closed_loop_success(trainer: VLATrainer, config: DictConfig) -> float | None:
    """Success rate of the averaged weights on episodes that no demonstration was made from; None without robosuite."""
    if importlib.util.find_spec("robosuite") is None:
        return None
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.envs.for_policy import instructed_env
    from torchrl_sparse.evaluation.rollouts.evaluate import evaluate, success_rate

    policy = averaged_policy(trainer)
    episodes = evaluate(
        "dense",
        ChunkExecutor(policy, config.n_action_steps),
        instructed_env(config.task, policy.network.config, chosen_cameras(config.cameras)),
        range(DEVELOPMENT_SEED, DEVELOPMENT_SEED + config.eval_episodes),
        num_envs=min(5, config.eval_episodes),
        policy_device=config.device,
    )
    return success_rate(episodes)


if __name__ == "__main__":
    main()
