"""Make demonstrations to train on of a file as robomimic publishes it; kill it at any moment and run it again to go on.

    python recipes/convert_robomimic.py demos=low_dim_v15.hdf5 out=data/lift_human.h5
    python recipes/train_policy.py task=lift demos=data/lift_human.h5 filter_key=train

Deltas become absolute actions, observations are made anew from the recorded states, images are copied. Of Diffusion Policy's
``*_abs.hdf5``, which hold poses and still name a controller of deltas, say ``poses=true``.
"""

from __future__ import annotations

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.data.absolute import convert_demos


@recipe("convert_robomimic", out="file")
def main(config: DictConfig) -> None:
    number = convert_demos(config.demos, config.out, poses=config.poses)
    print(f"{config.out}: {number} demonstrations with absolute actions")


if __name__ == "__main__":
    main()
