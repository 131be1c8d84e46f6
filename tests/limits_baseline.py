"""What the processes of `tests.limits` have imported and used before anything is measured."""

from pathlib import Path

import torchrl_sparse.data.robomimic
import torchrl_sparse.evaluation.rollouts.episodes  # noqa: F401
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

VLAPolicy(VLANetwork(VLAConfig.tiny()))
DiffusionPolicy.from_pretrained(Path(__file__).parents[1] / "assets" / "lift")
