"""Collect scripted demonstrations; kill it at any moment and run it again to go on.

    python recipes/collect_demos.py task=lift episodes=200 quality=proficient out=data/lift_proficient.h5

The last line tells how many of the attempted episodes succeeded. To measure an expert on unseen seeds:

    python recipes/collect_demos.py task=lift episodes=100 seed=10000 keep_failures=true out=data/unseen.h5
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from torchrl_sparse.data.demos import Collection, Summary, collect


@hydra.main(version_base=None, config_path=".", config_name="collect_demos")
def main(config: DictConfig) -> None:
    torch.set_num_threads(1)
    collection = Collection(
        task=config.task,
        episodes=config.episodes,
        quality=config.quality,
        seed=config.seed,
        keep_failures=config.keep_failures,
    )
    with tqdm(total=collection.episodes, unit="demo", desc=f"{config.task} {config.quality}") as bar:

        def show(tally: Summary) -> None:
            bar.set_postfix_str(f"{tally.successes}/{tally.attempts} succeeded", refresh=False)
            bar.update(tally.kept - bar.n)

        summary = collect(
            config.out, collection, workers=config.workers, backend=config.backend, on_episode=show
        )
    print(f"{config.out}: {config.task} {config.quality}, {summary}")


if __name__ == "__main__":
    main()
