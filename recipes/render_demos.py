"""Add camera images to demonstrations, for image policies.

python recipes/render_demos.py demos=data/lift_proficient.h5 out=data/lift_images.h5
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from torchrl_sparse.data.rendering import render_demos


@hydra.main(version_base=None, config_path=".", config_name="render_demos")
def main(config: DictConfig) -> None:
    render_demos(config.demos, config.out, list(config.cameras), image_size=config.image_size)
    print(f"{config.out}: images of {', '.join(config.cameras)}")


if __name__ == "__main__":
    main()
