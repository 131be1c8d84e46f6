"""Trains SAG's pruner, or L2C's static gates, for a trained policy.

    python recipes/train_pruner.py task=can policy=assets/can demos=data/can_proficient.h5 rate=0.91 out=runs/sag_can

Stop it at any moment; the same command goes on, equal to the last bit. ``out/pruner`` is for
`SAGPruner.from_pretrained`, and ``out/fixed.json`` beside it is its mean mask, the ablation; ``out/l2c.json`` is for
`SchedulePlanner`; ``out/curves.png`` shows how it went.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from torchrl_sparse.blocks.l2c import StaticGates
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.evaluation.figures.training import plot_pruner_curves, read_scalars
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.interrupt import StopSignal
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.training.diffusion.published import published_shape
from torchrl_sparse.training.loop import make_logger
from torchrl_sparse.training.pruner.reference import make_reference, with_queries
from torchrl_sparse.training.pruner.trainer import PrunerConfig, PrunerTrainer, imitate


@hydra.main(version_base=None, config_path=".", config_name="train_pruner")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy = DiffusionPolicy.from_pretrained(config.policy)
    if config.sampler is not None:
        policy.sampler = Sampler(**config.sampler)
    out = Path(config.out)
    trainer = make_trainer(policy, reference_set(policy, config), config)
    if (out / "checkpoint.pt").exists():
        trainer.load(out / "checkpoint.pt")
        print(f"{out / 'checkpoint.pt'}: going on from update {trainer.step}")
    elif schedules := initial_schedules(config):
        learn_schedules(trainer, schedules)
    stop = StopSignal()
    train(trainer, config, stop)
    if config.logger == "csv" and trainer.step >= config.log_every:
        plot_pruner_curves(read_scalars(out / "log"), out / "curves.png", rate=trainer.config.rate)
    how = f"stopped by {stop.name}, run again to go on" if stop.name else "finished"
    print(f"{save(trainer, config)}: update {trainer.step} of {trainer.total}, {how}; {trainer.validate()}")


def reference_set(policy: DiffusionPolicy, config: DictConfig) -> TensorDict:
    """The reference set, from ``out/reference.safetensors`` if it was made before."""
    path = Path(config.out) / "reference.safetensors"
    made_for = {
        "policy": policy.fingerprint,
        **policy.sampler.config,
        "demos": config.demos,
        **config.reference,
        "rollouts": [config.rollouts, *initial_schedules(config)[:1]] if config.rollouts else [],
    }
    if path.exists():
        return read_reference(path, made_for)
    task = find_task(config.task)
    demos = read_demos(config.demos, task.state_keys, poses=task.acts_in_poses)
    with progress("window", "dense answers") as show:
        reference = make_reference(policy, demos, **config.reference, on_progress=show)
    if config.rollouts:
        queries = closed_loop_queries(policy, config)
        with progress("query", "dense answers") as show:
            reference = with_queries(policy, reference, queries, seed=config.reference.seed, on_progress=show)
    with atomic_path(path) as temporary:
        save_file(dict(reference.flatten_keys("/").items()), temporary, {"made_for": json.dumps(made_for)})
    return reference


def closed_loop_queries(policy: DiffusionPolicy, config: DictConfig) -> TensorDictBase:
    """What is asked in episodes under the first of the schedules in ``init``, or under the dense policy."""
    if config.reference.target != "teacher":
        raise ValueError(
            f"rollouts: no demonstration says what to do in them; expected reference.target=teacher, "
            f"got {config.reference.target}"
        )
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.control.queries import record_queries
    from torchrl_sparse.envs.for_policy import diffusion_env
    from torchrl_sparse.envs.seeds import CLOSED_LOOP_SEED

    task, schedules = find_task(config.task), initial_schedules(config)
    played = policy.with_plan(SchedulePlanner.from_pretrained(schedules[0]) if schedules else None)
    actor = ChunkExecutor(played, n_action_steps=published_shape(task.name).n_action_steps)
    seeds = range(CLOSED_LOOP_SEED, CLOSED_LOOP_SEED + config.rollouts)
    return record_queries(actor, diffusion_env(task.name, policy), seeds)


@contextmanager
def progress(unit: str, desc: str) -> Iterator[Callable[[int, int], None]]:
    """A bar that is told (done, total)."""
    with tqdm(unit=unit, desc=desc, mininterval=2) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def read_reference(path: Path, made_for: dict) -> TensorDict:
    with safe_open(path, "pt") as file:
        found = json.loads(file.metadata()["made_for"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, it is no dict
    if found != made_for:
        raise ValueError(
            f"{path}: expected a reference set for {made_for}, got one for {found}; remove it or change out"
        )
    return TensorDict(tensors, batch_size=[len(tensors["target"])]).unflatten_keys("/")


def make_trainer(policy: DiffusionPolicy, reference: TensorDict, config: DictConfig) -> PrunerTrainer:
    options = PrunerConfig(**OmegaConf.to_container(config.train, resolve=True))
    torch.manual_seed(options.seed)
    if config.method == "sag":
        gates = PrunerNetwork(
            policy.sampler.timesteps.tolist(),
            policy.num_blocks,
            (policy.n_obs_steps, policy.network.cond_dim),
            rate_input=options.rate_range is not None,
            **config.network,
        )
    elif config.method == "l2c":
        gates = StaticGates(policy.num_inference_steps, policy.num_blocks)
    else:
        raise ValueError(f"method: expected 'sag' or 'l2c', got {config.method!r}")
    return PrunerTrainer(gates, policy, reference, options)


def initial_schedules(config: DictConfig) -> list[str]:
    return [config.init] if isinstance(config.init, str) else list(config.init or [])


def learn_schedules(trainer: PrunerTrainer, paths: list[str]) -> None:
    masks = [CacheSchedule.from_pretrained(path).mask() for path in paths]
    with progress("update", "learning the schedules") as show:
        imitate(trainer.gates, masks, trainer.train_set, seed=trainer.config.seed, on_progress=show)
    print(f"{', '.join(paths)}: learned, {trainer.validate()}")


def train(trainer: PrunerTrainer, config: DictConfig, stop: StopSignal) -> None:
    """Updates until the end or a signal, logging and saving on the way."""
    settings = OmegaConf.to_container(config, resolve=True)
    logger = make_logger(config.logger, config.out, settings=settings, wandb_mode=config.wandb_mode)
    with tqdm(total=trainer.total, initial=trainer.step, unit="update", mininterval=2) as bar:
        while trainer.step < trainer.total and stop.name is None:
            metrics = trainer.train_step()
            bar.update()
            if trainer.step % config.log_every == 0:
                bar.set_postfix(fidelity=f"{metrics['fidelity']:.4f}", rate=f"{metrics['rate']:.3f}")
                logger.log_metrics({f"train/{name}": v for name, v in metrics.items()}, step=trainer.step)
            if trainer.step % config.checkpoint_every == 0:
                save(trainer, config)
                held_out = trainer.validate()
                logger.log_metrics({f"held_out/{name}": v for name, v in held_out.items()}, step=trainer.step)


def save(trainer: PrunerTrainer, config: DictConfig) -> Path:
    """Writes the checkpoint and the pruner or schedule as it is now; returns where that is."""
    out, policy = Path(config.out), trainer.policy
    trainer.save(out / "checkpoint.pt")
    settings = {
        **asdict(trainer.config),
        "init": initial_schedules(config),
        "reference": dict(config.reference),
        "rollouts": config.rollouts,
        "updates": trainer.step,
    }
    fixed = CacheSchedule.from_mask(
        trainer.fixed_mask(),
        method="l2c" if config.method == "l2c" else "sag_fixed",
        policy=policy.fingerprint,
        sampler=policy.sampler.name,
        reuse=trainer.config.reuse,
        settings=settings,
    )
    path = out / ("l2c.json" if config.method == "l2c" else "fixed.json")
    fixed.save_pretrained(path)
    if config.method == "l2c":
        return path
    info = PrunerInfo(
        policy=policy.fingerprint,
        sampler=policy.sampler.name,
        rate=trainer.config.rate,
        rate_range=trainer.config.rate_range,
        reuse=trainer.config.reuse,
        settings=settings,
    )
    SAGPruner(trainer.gates, info).save_pretrained(out / "pruner")
    return out / "pruner"


if __name__ == "__main__":
    main()
