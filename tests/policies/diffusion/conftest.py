"""A small policy whose blocks matter."""

import pytest
import torch

from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, TransformerForDiffusion


@pytest.fixture
def policy():
    torch.manual_seed(0)
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}
    network = TransformerForDiffusion(**sizes, n_layer=2, n_emb=32)
    normalizer = Normalizer(
        torch.full((5,), 0.5), torch.zeros(5), torch.full((4,), 2.0), torch.full((4,), 0.1)
    )
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 8))
