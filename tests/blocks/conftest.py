"""A small denoiser whose blocks matter, and random masks for it."""

import pytest
import torch

from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

NUM_STEPS, NUM_LAYERS, HORIZON, ACTION_DIM, OBS_STEPS, COND_DIM = 10, 2, 6, 4, 2, 5


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        input_dim=ACTION_DIM,
        output_dim=ACTION_DIM,
        horizon=HORIZON,
        n_obs_steps=OBS_STEPS,
        cond_dim=COND_DIM,
        n_layer=NUM_LAYERS,
        n_emb=32,
    )
    # The published initialisation (std 0.02) leaves blocks that hardly change anything.
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network.eval().requires_grad_(False)


@pytest.fixture(params=["ddpm", "ddim", "ddim_eta0.5", "unipc"])
def sampler(request):
    return Sampler.from_name(request.param, NUM_STEPS)


@pytest.fixture
def ddpm():
    return Sampler("ddpm", NUM_STEPS)


@pytest.fixture
def query():
    """Noise [5, K, H, A] and condition [5, To, D] of five policy calls."""
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(5, NUM_STEPS, HORIZON, ACTION_DIM, generator=generator)
    return noise, torch.randn(5, OBS_STEPS, COND_DIM, generator=generator)


def random_mask(*batch, rate=0.5, seed=2):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(*batch, NUM_STEPS, 3 * NUM_LAYERS, generator=generator) < rate
    mask[..., 0, :] = False
    return mask
