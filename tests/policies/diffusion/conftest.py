"""A small policy whose blocks matter."""

import pytest
import torch

from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder


@pytest.fixture
def policy():
    torch.manual_seed(0)
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
    network = TransformerForDiffusion(**sizes, n_layer=2, n_emb=32)
    normalizer = Normalizer(
        torch.full((5,), 0.5), torch.zeros(5), torch.full((4,), 2.0), torch.full((4,), 0.1)
    )
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 8))


@pytest.fixture
def make_image_policy():
    def make():
        torch.manual_seed(0)
        vision = VisionEncoder(["image", "wrist_image"], image_size=(40, 44), crop_size=(34, 40), width=16)
        network = TransformerForDiffusion(
            input_dim=4, output_dim=4, horizon=6, n_obs_steps=2, cond_dim=131, n_layer=1, n_emb=32
        )
        normalizer = Normalizer(torch.ones(3), torch.zeros(3), torch.ones(4), torch.zeros(4))
        return DiffusionPolicy(network, normalizer, vision=vision, sampler=Sampler("ddim", 2))

    return make
