"""What processes that `tests.forked` makes have imported and used before they begin: all that is slow to import."""

from pathlib import Path

import matplotlib.pyplot  # noqa: F401
import robosuite  # noqa: F401
import torchrl.collectors  # noqa: F401

import torchrl_sparse.cli.recipe
import torchrl_sparse.data.robomimic
import torchrl_sparse.envs.robosuite
import torchrl_sparse.evaluation.benchmarks.diffusion
import torchrl_sparse.evaluation.benchmarks.vla_benchmark  # noqa: F401
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy

VLAPolicy(VLANetwork(VLAConfig.tiny()))
DiffusionPolicy.from_pretrained(Path(__file__).parents[1] / "assets" / "lift")
