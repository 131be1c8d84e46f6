"""Make demonstrations to train on of the human ones of Push-T that Diffusion Policy published.

    python recipes/convert_pusht.py demos=pusht_human.npz out=data/pusht_human.h5
    python recipes/train_policy.py task=pusht demos=data/pusht_human.h5

Observations are made anew from the recorded states; what the npz holds is in `torchrl_sparse.data.pusht_human`.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from torchrl_sparse.data.pusht_human import convert_pusht


@hydra.main(version_base=None, config_path=".", config_name="convert_pusht")
def main(config: DictConfig) -> None:
    number = convert_pusht(config.demos, config.out)
    print(f"{config.out}: {number} demonstrations")


if __name__ == "__main__":
    main()
