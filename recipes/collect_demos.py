"""Collect demonstrations by an expert, or by DAgger.

Kill it at any moment and run it again to go on.

    python recipes/collect_demos.py task=lift episodes=200 quality=proficient out=data/lift_proficient.h5

The last line tells how many of the attempted episodes succeeded. To measure an expert on unseen seeds:

    python recipes/collect_demos.py task=lift episodes=100 seed=10000 keep_failures=true out=data/unseen.h5

DAgger: a policy drives and the expert takes over, so that a training on both files learns to get out of where the policy leads:

    python recipes/collect_demos.py task=can episodes=200 seed=1000 policy=assets/can method=dense:int8 out=data/can_dagger.h5
"""

from __future__ import annotations

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.dagger import Driving
from torchrl_sparse.data.demos import Collection, Summary, collect
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.published import executed_steps


@recipe("collect_demos", out="file")
def main(config: DictConfig) -> None:
    torch.set_num_threads(1)
    collection = Collection(
        task=config.task,
        episodes=config.episodes,
        quality=config.quality,
        seed=config.seed,
        keep_failures=config.keep_failures,
        driving=None if config.policy is None else driving(config),
    )
    with tqdm(total=collection.episodes, unit="demo", desc=f"{config.task} {config.quality}") as bar:

        def show(tally: Summary) -> None:
            bar.set_postfix_str(f"{tally.successes}/{tally.attempts} succeeded", refresh=False)
            bar.update(tally.kept - bar.n)

        summary = collect(
            config.out, collection, workers=config.workers, backend=config.backend, on_episode=show
        )
    print(f"{config.out}: {config.task} {config.quality}, {summary}")


def driving(config: DictConfig) -> Driving:
    policy = DiffusionPolicy.from_pretrained(config.policy)
    steps = executed_steps(config.task, policy.source)
    return Driving(config.policy, policy.fingerprint, config.method, steps, config.mixing)


if __name__ == "__main__":
    main()
