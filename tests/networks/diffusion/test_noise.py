"""What chains of different length share of a query's noise."""

import pytest
import torch

from torchrl_sparse.networks.diffusion.noise import sample_noise


@pytest.mark.parametrize("chunk", [(10, 7), (16, 10)])
@pytest.mark.parametrize("steps", [1, 2, 3, 10])
def test_short_chains_start_where_long_ones_do_and_read_on_in_the_same_stream(chunk, steps):
    seeds = torch.tensor([3, 12, 2**61])
    short, long = sample_noise(seeds, steps, chunk), sample_noise(seeds, 100, chunk)
    assert torch.equal(short[:, 0], long[:, 0])
    assert torch.equal(short[:, : steps - 1], long[:, : steps - 1])
    assert (short != long[:, :steps]).flatten(1).sum(dim=1).max() <= 16
