"""Find the timesteps at which few DDIM steps of a trained policy come closest to its demonstrations.

    python recipes/calibrate_timesteps.py task=square demos=data/square_recovering.h5 num_inference_steps=3

The result is the name of a benchmark's method, e.g. ``ddim_90_50_10``; ``out`` also lists all that was tried.
"""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.published import published_shape
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.diffusion.timesteps import demonstration_error, search_timesteps


@recipe("calibrate_timesteps")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy = DiffusionPolicy.from_pretrained(config.policy)
    task = find_task(config.task)
    demos = read_demos(config.demos, task.state_keys, poses=task.acts_in_poses)
    n_action_steps = published_shape(task.name).n_action_steps
    targets = make_targets(policy, demos, source="data", n_action_steps=n_action_steps, **config.targets)
    train_steps = policy.sampler.num_train_timesteps
    start = Sampler("ddim", config.num_inference_steps, train_steps).timesteps.tolist()
    with tqdm(desc="chains", unit="chain", mininterval=2) as bar:

        def error(timesteps: tuple[int, ...]) -> float:
            bar.update()
            return demonstration_error(policy, targets, timesteps, n_action_steps=n_action_steps)

        best, tried = search_timesteps(error, start, num_train_timesteps=train_steps, strides=config.strides)
    chosen = Sampler("ddim", num_train_timesteps=train_steps, timesteps=best)
    path = Path(config.out) / f"{chosen.name}.json"
    write_json(path, report(policy, tried, config))
    print(
        f"{path}: {chosen.name}, error {tried[best]:.4f}; evenly spaced {start}, error {tried[tuple(start)]:.4f}"
    )


def report(policy: DiffusionPolicy, tried: dict[tuple[int, ...], float], config: DictConfig) -> dict:
    """Return everything that was tried, best first, and what it was tried with."""
    ordered = sorted(tried.items(), key=lambda entry: entry[1])
    return {
        "policy": policy.fingerprint,
        "settings": OmegaConf.to_container(config, resolve=True),
        "tried": [{"timesteps": timesteps, "error": error} for timesteps, error in ordered],
    }


if __name__ == "__main__":
    main()
