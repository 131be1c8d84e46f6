"""Compute the BAC schedules of a policy, without training.

One dense policy call is all that it takes.

    python recipes/calibrate_bac.py task=lift policy=assets/lift num_updates=10
    python recipes/calibrate_bac.py task=lift policy=assets/lift num_updates=3 sampler=ddpm10

With a sampler, the files are called ``bac_ddpm10.json`` and so on, and so are the methods of a benchmark.
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from torchrl_sparse.blocks.bac import SCHEDULES
from torchrl_sparse.blocks.mask import prune_rate, query_flops
from torchrl_sparse.blocks.planner import Dense
from torchrl_sparse.cli.recipe import benchmark_command, recipe
from torchrl_sparse.envs.for_policy import diffusion_env
from torchrl_sparse.envs.seeds import tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.calibration import calibrate_policy


@recipe("calibrate_bac")
def main(config: DictConfig) -> None:
    task = find_task(config.task).name
    policy = DiffusionPolicy.from_pretrained(config.policy).to(config.device)
    if config.sampler is not None:
        policy.sampler = policy.sampler.variant_named(config.sampler)
    environment = diffusion_env(task, policy)
    seeds = tuning_seeds(config.seed, config.samples)
    calibration = calibrate_policy(policy, environment, seeds)
    dense = query_flops(policy.network, Dense().mask(policy.plan.spec))
    made = [
        Path(config.out) / f"{'_'.join(filter(None, [name, config.sampler]))}.json" for name in config.methods
    ]
    for name, path in zip(config.methods, made, strict=True):
        options = {"top_k": config.top_k} if name == "bac" else {}
        schedule = SCHEDULES[name](
            calibration, config.num_updates, policy=policy.fingerprint, objective=config.objective, **options
        )
        schedule.save_pretrained(path)
        mask = schedule.mask()
        ratio = query_flops(policy.network, mask) / dense
        print(f"{path}: prune rate {prune_rate(mask):.3f}, {ratio:.3f} of the dense FLOPs")
    print(benchmark_command(config.task, config.policy, config.out, [path.stem for path in made]))


if __name__ == "__main__":
    main()
