"""Train a small vision-language-action policy.

Stop it at any moment; the same command resumes it, equal to the last bit.

    python recipes/collect_demos.py task=lift_named episodes=600 out=data/lift_named_proficient.h5
    views="cameras=[agentview,robot0_eye_in_hand]"
    python recipes/convert_demos.py demos=data/lift_named_proficient.h5 out=data/lift_named_images.h5 "$views"
    python recipes/train_vla.py task=lift_named precision=bf16
    python recipes/train_vla.py task=lift_named precision=bf16 base=SmolLM2-135M-Instruct.Q4_1.gguf +network.patch_size=7

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for `VLAPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
from functools import partial
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_sparse import keys
from torchrl_sparse.cli.options import given
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.for_policy import instructed_demos
from torchrl_sparse.data.images import chosen_cameras
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.instructed import continued_vla_source
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, tuning_seeds
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import VLASource
from torchrl_sparse.training.demonstrations import TrainConfig, trained_parameters
from torchrl_sparse.training.loop import train
from torchrl_sparse.training.vla.grounding import GroundingConfig, ObjectPositions
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations, VLATrainer
from torchrl_sparse.training.vla.untrained import check_sizes, untrained_policy


@recipe("train_vla")
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


def make_trainer(config: DictConfig) -> VLATrainer:
    """Read the demonstrations and build a trainer."""
    cameras, policy, changes = chosen_cameras(config.cameras), None, given(config.network)
    if config.init is not None:
        policy = VLAPolicy.from_pretrained(config.init, base=config.base, fold=False)
        policy.source = continued_vla_source(config.task, policy, cameras)
        check_sizes(policy, config.init, size=config.size, rank=config.rank, changes=changes)
    stages, images = GroundingConfig(**config.grounding), Path(config.out) / "images"
    episodes = instructed_demos(config.demos, config.task, cameras, policy, image_folder=images)
    objects = None if stages == GroundingConfig() else read_objects(config)
    demos = InstructedDemonstrations(episodes, read_instructions(config.demos), objects)
    if policy is None:
        config.size, config.rank = config.size or "small", config.rank or 16
        config.network = {"chunk_size": 8, **changes}
        sizes = {"changes": config.network, "base": config.base, "rank": config.rank}
        policy = untrained_policy(demos, config.size, cameras=[*cameras], seed=config.seed, **sizes)
        policy.source = VLASource(find_robosuite_task(config.task).name, cameras)
    trainer = VLATrainer(policy.to(config.device), demos, TrainConfig(**config.train), stages)
    print(
        f"{config.demos}: {len(episodes)} demonstrations of {len(set(demos.instructions))} instructions, "
        f"{len(episodes.data)} steps, {len(trainer.train_rows)} training windows; "
        f"{sum(p.numel() for p in trained_parameters(policy.network)):,} parameters to train"
    )
    return trainer


def read_objects(config: DictConfig) -> ObjectPositions:
    """Return the positions of the objects that the task's instructions name, in the order of the instructions."""
    task = find_robosuite_task(config.task)
    positions = read_demos(config.demos, ["object_positions"], task=task.name).data[keys.STATE]
    return ObjectPositions(positions.unflatten(1, (-1, 3)), task.instructions).standardised()


def export(trainer: VLATrainer, config: DictConfig) -> Path:
    averaged_policy(trainer).save_pretrained(path := Path(config.out) / "policy")
    return path


def averaged_policy(trainer: VLATrainer) -> VLAPolicy:
    policy = VLAPolicy(trainer.averaged(), trainer.policy.normalizer, trainer.policy.tokenizer)
    policy.source, policy.base = trainer.policy.source, trainer.policy.base
    return policy


def closed_loop_success(trainer: VLATrainer, config: DictConfig) -> float | None:
    """Return the success rate of the averaged weights on development episodes; None without robosuite."""
    if importlib.util.find_spec("robosuite") is None:
        return None
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.envs.instructed import instructed_env
    from torchrl_sparse.evaluation.rollouts.evaluate import evaluate, success_rate

    policy = averaged_policy(trainer)
    episodes = evaluate(
        "dense",
        ChunkExecutor(policy, config.n_action_steps),
        instructed_env(config.task, policy, policy.source.cameras),
        tuning_seeds(DEVELOPMENT_SEED, config.eval_episodes),
        num_envs=min(5, config.eval_episodes),
        policy_device=config.device,
    )
    return success_rate(episodes)


if __name__ == "__main__":
    main()
