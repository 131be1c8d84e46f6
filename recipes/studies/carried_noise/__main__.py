"""Measure how strongly a policy's actions depend on the initial noise, to explain why deterministic samplers lose.

    python -m recipes.studies.carried_noise task=lift demos=data/lift_proficient.h5

No simulator is needed: demonstrations are asked many times, with noise that is drawn again each time.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
from omegaconf import DictConfig
from pydantic import Field
from tqdm import tqdm

from recipes.studies.carried_noise.chains import carried_noise
from recipes.studies.carried_noise.figures import plot_carried_noise
from recipes.studies.carried_noise.results import CarriedNoiseResults, save_carried_noise
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.for_policy import policy_demos
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps
from torchrl_sparse.training.diffusion.targets import make_targets

OPTIONS = {"draws": Annotated[int, Field(ge=3)]}
"""Options that no recipe of the library has -> type."""


@recipe("carried_noise", options=OPTIONS)
def main(config: DictConfig) -> None:
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    policy, task = DiffusionPolicy.from_pretrained(config.policy).to(config.device), find_task(config.task)
    samplers = {name: policy.sampler.variant_named(name) for name in config.samplers}
    demos = policy_demos(config.demos, task.name, policy)
    n_action_steps = executed_steps(task.name, policy.source)
    targets = make_targets(policy, demos, source="data", n_action_steps=n_action_steps, **config.targets)
    options = {"draws": config.draws, "seed": config.targets.seed, "n_action_steps": n_action_steps}
    calls = len(targets) * config.draws * sum(s.num_inference_steps for s in samplers.values())
    with tqdm(desc="network", total=calls, unit="sample", mininterval=2) as bar:
        chains = {
            name: carried_noise(policy, targets, sampler, on_progress=bar.update, **options)
            for name, sampler in samplers.items()
        }
    sizes = (len(targets), config.draws, config.targets.seed)
    results = CarriedNoiseResults(1, task.name, policy.fingerprint, *sizes, chains)
    path = Path(config.out) / f"carried_noise_{task.name}.json"
    save_carried_noise(results, path)
    plot_carried_noise(results, path.with_suffix(".png"))
    for name, chain in chains.items():
        left = f"correlation of the last step {chain.correlation[-1]:+.2f}"
        print(f"{name}: {left}, spread {chain.spread:.3f}, error {chain.error:.3f}")


if __name__ == "__main__":
    main()
