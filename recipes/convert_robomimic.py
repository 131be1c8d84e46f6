"""Make demonstrations to train on of a file as robomimic publishes it; kill it at any moment and run it again to go on.

    python recipes/convert_robomimic.py demos=low_dim_v15.hdf5 out=data/lift_human.h5
    python recipes/train_policy.py task=lift demos=data/lift_human.h5 filter_key=train

Deltas become absolute actions, observations are made anew from the recorded states, images are copied.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from torchrl_sparse.data.absolute import convert_demos


@hydra.main(version_base=None, config_path=".", config_name="convert_robomimic")
def main(config: DictConfig) -> None:
    number = convert_demos(config.demos, config.out)
    print(f"{config.out}: {number} demonstrations with absolute actions")


if __name__ == "__main__":
    main()
