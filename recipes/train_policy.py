"""Trains a diffusion policy. Stop it at any moment; the same command goes on, equal to the last bit.

    python recipes/train_policy.py demos=data/lift_proficient.h5 out=runs/lift max_steps=20000 batch_size=128

``out/policy``, renewed at each checkpoint, is the policy with averaged weights for
`DiffusionPolicy.from_pretrained`.
"""

from __future__ import annotations

import importlib.util
import time
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.record.loggers import Logger
from tqdm import tqdm

from torchrl_sparse import keys
from torchrl_sparse.data.normalize import Normalizer
from torchrl_sparse.data.robomimic import Demonstrations, read_demos
from torchrl_sparse.envs.tasks import get_task
from torchrl_sparse.evaluation.tracking import training_logger
from torchrl_sparse.interrupt import StopSignal
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
from torchrl_sparse.policies.diffusion.training import PolicyTrainer
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.policies.diffusion.vision import VisionEncoder
from torchrl_sparse.policies.trainer import TrainConfig


@hydra.main(version_base=None, config_path=".", config_name="train_policy")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    trainer = make_trainer(config)
    out = Path(config.out)
    if (out / "checkpoint.pt").exists():
        trainer.load(out / "checkpoint.pt")
        print(f"{out / 'checkpoint.pt'}: going on from step {trainer.step}")
    stop = StopSignal()
    train(
        trainer,
        config,
        training_logger(
            config.logger, config.out, config.wandb_mode, OmegaConf.to_container(config, resolve=True)
        ),
        stop,
    )
    save(trainer, config)
    how = f"stopped by {stop.name}, run again to go on" if stop.name else "finished"
    print(f"{out / 'policy'}: step {trainer.step} of {trainer.config.max_steps}, {how}")


def make_trainer(config: DictConfig) -> PolicyTrainer:
    """Reads the demonstrations and builds an untrained network that fits them."""
    task, cameras = get_task(config.task), chosen_cameras(config)
    demos = read_demos(
        config.demos,
        task.proprioception_keys if cameras else task.state_keys,
        cameras=cameras,
        image_folder=Path(config.out) / "images",
    )
    state, action = demos.data[keys.STATE], demos.data[keys.ACTION]
    normalizer = Normalizer.fit(state, action, state_mode=config.state_normalization).to(config.device)
    torch.manual_seed(config.seed)
    vision = make_vision(demos, cameras, config) if cameras else None
    features = 0 if vision is None else vision.feature_dim
    network = TransformerForDiffusion(
        input_dim=action.shape[-1],
        output_dim=action.shape[-1],
        cond_dim=features + state.shape[-1],
        **config.network,
    ).to(config.device)
    trainer = PolicyTrainer(network, normalizer, demos, TrainConfig(**config.train), vision)
    print(
        f"{config.demos}: {len(demos)} demonstrations, {len(state)} steps, "
        f"{len(trainer.train_rows)} training windows; "
        f"{sum(p.numel() for p in network.parameters()):,} parameters"
    )
    return trainer


def chosen_cameras(config: DictConfig) -> dict[str, str]:
    """Name of an image here -> its name in the demonstrations."""
    return {name: key for name, key in config.cameras.items() if key is not None}


def make_vision(demos: Demonstrations, cameras: dict[str, str], config: DictConfig) -> VisionEncoder:
    image_size = demos.data["observation", next(iter(cameras))].shape[-2:]
    crop_size = [round(config.vision.crop * size) for size in image_size]
    vision = VisionEncoder([*cameras], image_size=image_size, crop_size=crop_size, width=config.vision.width)
    return vision.to(config.device)


def train(trainer: PolicyTrainer, config: DictConfig, logger: Logger, stop: StopSignal) -> None:
    """Steps until the end or a signal, logging, evaluating and saving on the way."""
    total, losses, last = trainer.config.max_steps, [], time.perf_counter()
    with tqdm(total=total, initial=trainer.step, unit="step", mininterval=2) as bar:
        while trainer.step < total and stop.name is None:
            losses.append(trainer.train_step())
            bar.update()
            if trainer.step % config.log_every == 0:
                now = time.perf_counter()
                metrics = {"train/loss": sum(losses) / len(losses), "train/lr": trainer.lr}
                metrics["train/seconds_per_step"] = (now - last) / len(losses)
                bar.set_postfix(loss=f"{metrics['train/loss']:.4f}")
                logger.log_metrics(metrics, step=trainer.step)
                losses, last = [], now
            if trainer.step % config.checkpoint_every == 0:
                save(trainer, config)
                logger.log_metrics({"val/loss": trainer.validate()}, step=trainer.step)
            if config.eval_every and trainer.step % config.eval_every == 0:
                evaluate(trainer, config, logger)


def save(trainer: PolicyTrainer, config: DictConfig) -> None:
    trainer.save(Path(config.out) / "checkpoint.pt")
    averaged_policy(trainer, config).save_pretrained(Path(config.out) / "policy")


def averaged_policy(
    trainer: PolicyTrainer, config: DictConfig, schedule: NoiseSchedule | None = None
) -> DiffusionPolicy:
    """With a note of the cameras, for whoever makes an environment for it."""
    policy = trainer.ema_policy(schedule)
    if cameras := chosen_cameras(config):
        policy.source = {"task": get_task(config.task).alias, "cameras": cameras}
    return policy


def evaluate(trainer: PolicyTrainer, config: DictConfig, logger: Logger) -> None:
    """Logs the success rate of the averaged weights on episodes that no demonstration was made from."""
    if importlib.util.find_spec("robosuite") is None:
        return
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.envs.transforms import make_env
    from torchrl_sparse.evaluation.methods import env_options
    from torchrl_sparse.evaluation.paired import rollout_episodes

    schedule = NoiseSchedule("ddim", config.eval_ddim_steps) if config.eval_ddim_steps else NoiseSchedule()
    policy = averaged_policy(trainer, config, schedule)
    episodes = rollout_episodes(
        ChunkExecutor(policy, trainer.config.n_action_steps),
        partial(make_env, get_task(config.task).name, **env_options(policy)),
        range(config.eval_seed, config.eval_seed + config.eval_episodes),
        num_envs=min(5, config.eval_episodes),
        policy_device=config.device,
    )
    rate = sum(episode.success for episode in episodes) / len(episodes)
    tqdm.write(f"step {trainer.step}: success rate {rate:.2f} of {len(episodes)} episodes")
    logger.log_metrics({"eval/success": rate}, step=trainer.step)


if __name__ == "__main__":
    main()
