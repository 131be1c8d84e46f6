"""A small policy, what its gates are trained on, and the gates."""

import pytest
import torch
from tensordict import TensorDict

from tests.blocks import conftest as blocks
from tests.blocks.conftest import ACTION_DIM, COND_DIM, NUM_LAYERS, NUM_STEPS, OBS_STEPS
from tests.fixtures.diffusion import make_image_demos  # noqa: F401
from tests.policies.diffusion.conftest import make_image_policy  # noqa: F401
from torchrl_sparse import keys
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.targets import make_targets

NUM_BLOCKS = 3 * NUM_LAYERS
network = blocks.network  # pytest finds fixtures by the names of a module


@pytest.fixture
def policy(network):
    normalizer = Normalizer(
        *(fill(size) for size in (COND_DIM, ACTION_DIM) for fill in (torch.ones, torch.zeros))
    )
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddim", NUM_STEPS))


@pytest.fixture
def demos():
    generator = torch.Generator().manual_seed(0)
    data = {
        keys.STATE: torch.randn(60, COND_DIM, generator=generator),
        keys.ACTION: torch.randn(60, ACTION_DIM, generator=generator).clamp(-1, 1),
    }
    return Demonstrations(TensorDict(data, [60]), torch.tensor([0, 20, 40, 60]))


@pytest.fixture
def targets(policy, demos):
    return make_targets(policy, demos, share=0.5, n_action_steps=4)


def sag_gates(policy, **options):
    torch.manual_seed(3)
    return PrunerNetwork(policy.sampler.timesteps.tolist(), NUM_BLOCKS, (OBS_STEPS, COND_DIM), **options)
