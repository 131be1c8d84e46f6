import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

SIZES = {"input_dim": 10, "output_dim": 10, "horizon": 6, "n_obs_steps": 2, "cond_dim": 5}


@pytest.fixture
def make_network():
    """A tiny network, the same in every call; its weights are large enough for every part to matter."""

    def make(**changes) -> TransformerForDiffusion:
        torch.manual_seed(0)
        network = TransformerForDiffusion(**{**SIZES, "n_layer": 2, "n_head": 2, "n_emb": 16, **changes})
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.3)
        return network.eval()

    return make


@pytest.fixture
def demos():
    """Eight random walks of 9 to 16 steps."""
    generator = torch.Generator().manual_seed(0)
    lengths = torch.arange(9, 17)
    steps = int(lengths.sum())
    data = {
        keys.STATE: torch.randn(steps, 5, generator=generator).cumsum(0) / 10,
        keys.ACTION: torch.rand(steps, 10, generator=generator) * 2 - 1,
    }
    return Demonstrations(
        TensorDict(data, [steps]), torch.cat([torch.zeros(1, dtype=torch.int64), lengths.cumsum(0)])
    )
