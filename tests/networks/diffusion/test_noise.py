"""What chains of different length share of a policy call's noise."""

import pytest
import torch

from torchrl_sparse.networks.diffusion.noise import NOISE_STREAM, query_seed, sample_noise


@pytest.mark.parametrize("chunk", [(10, 7), (16, 10)])
@pytest.mark.parametrize("steps", [1, 2, 3, 10])
def test_short_chains_start_where_long_ones_do_and_read_on_in_the_same_stream(chunk, steps):
    seeds = torch.tensor([3, 12, 2**61])
    short, long = sample_noise(seeds, steps, chunk), sample_noise(seeds, 100, chunk)
    assert torch.equal(short[:, 0], long[:, 0])
    assert torch.equal(short[:, : steps - 1], long[:, : steps - 1])
    assert (short != long[:, :steps]).flatten(1).sum(dim=1).max() <= 16


def test_seeds_are_those_of_the_published_round():
    """The first numbers of SplitMix64 from 1234567 on, without their highest bits."""
    step, increment = torch.tensor([[1234567], [0]]), 0x9E3779B97F4A7C15
    step[1] = 1234567 + increment - 2**64
    numbers = [6457827717110365317, 3203168211198807973]
    assert query_seed(torch.zeros_like(step), step).tolist() == [[number] for number in numbers]


def test_seeds_of_many_queries_are_those_of_each_and_wrap():
    seed, step = torch.tensor([[[7], [2**62]], [[-1], [0]]]), torch.tensor([[[0], [9]], [[3], [2**63 - 1]]])
    together = query_seed(seed, step)
    assert together.shape == seed.shape
    assert together.min() >= 0
    assert together.unique().numel() == 4
    for row, (one, other) in enumerate(zip(seed.view(-1), step.view(-1), strict=True)):
        assert query_seed(one, other) == together.view(-1)[row]
    assert torch.equal(query_seed(seed, step, stream=2), query_seed(seed + 2 * NOISE_STREAM, step))
    assert query_seed(seed[:0], step[:0]).shape == (0, 2, 1)
