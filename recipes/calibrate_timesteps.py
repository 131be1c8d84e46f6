"""Find the best timesteps for a few denoising steps.

Those at which a trained policy comes closest to its demonstrations.

    python recipes/calibrate_timesteps.py task=square demos=data/square_recovering.h5 kind=ddpm num_inference_steps=3

The result is the name of a benchmark's method, e.g. ``ddpm_90_50_10``; ``out`` lists all that was tried, and how the
spacings do that take no search, among them the rule ``logsnr``.
"""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from torchrl_sparse.cli.recipe import benchmark_command, recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.storage.json import write_json
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.diffusion.timesteps import FoundTimesteps, find_timesteps


@recipe("calibrate_timesteps")
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    task = find_task(config.task)
    demos = policy_demos(config.demos, task.name, policy)
    n_action_steps = executed_steps(task.name, policy.source)
    targets = make_targets(policy, demos, source="data", n_action_steps=n_action_steps, **config.targets)
    options = {name: config[name] for name in ("eta", "spacings", "strides")}
    with tqdm(desc="chains", unit="chain", mininterval=2) as bar:
        found = find_timesteps(
            policy,
            targets,
            config.kind,
            config.num_inference_steps,
            **options,
            n_action_steps=n_action_steps,
            on_chain=bar.update,
        )
    path = Path(config.out) / f"{found.sampler.name}.json"
    write_json(path, report(policy, found, config))
    print(f"{path}: {found.sampler.name}, error {found.error:.4f}")
    for spacing, timesteps in found.spacings.items():
        print(f"{spacing}: {list(timesteps)}, error {found.tried[timesteps]:.4f}")
    print(benchmark_command(config.task, config.policy, config.out, [found.sampler.name]))


def report(policy: DiffusionPolicy, found: FoundTimesteps, config: DictConfig) -> dict:
    """Return all timesteps tried, best first, with the errors of the standard spacings and the search settings."""
    ordered = sorted(found.tried.items(), key=lambda entry: entry[1])
    return {
        "policy": policy.fingerprint,
        "settings": OmegaConf.to_container(config, resolve=True),
        "spacings": {
            spacing: {"timesteps": timesteps, "error": found.tried[timesteps]}
            for spacing, timesteps in found.spacings.items()
        },
        "tried": [{"timesteps": timesteps, "error": error} for timesteps, error in ordered],
    }


if __name__ == "__main__":
    main()
