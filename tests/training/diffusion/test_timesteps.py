"""The search for timesteps against brute force, and its error against one by hand."""

from itertools import combinations

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.diffusion.timesteps import demonstration_error, search_timesteps


@pytest.mark.parametrize("valley", [(88, 41, 7), (99, 98, 97), (2, 1, 0)])
def test_finds_the_minimum_of_a_valley(valley):
    asked = []

    def error(timesteps):
        asked.append(timesteps)
        return sum((a - b) ** 2 for a, b in zip(timesteps, valley, strict=True))

    best, tried = search_timesteps(error, [66, 33, 0], strides=(10, 3, 1))
    assert best == valley
    assert len(asked) == len(set(asked)) == len(tried)
    assert all(99 >= a > b > c >= 0 for a, b, c in tried)


def test_no_single_move_is_better_than_what_is_found():
    """On a landscape without structure a descent may miss the lowest point, but not one beside it."""
    generator = torch.Generator().manual_seed(0)
    landscape = {
        pair[::-1]: torch.rand((), generator=generator).item() for pair in combinations(range(20), 2)
    }
    best, tried = search_timesteps(landscape.__getitem__, [10, 0], num_train_timesteps=20, strides=(1,))
    around = [(best[0] + a, best[1] + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    assert all(landscape[move] >= landscape[best] for move in around if move in landscape)
    assert tried.items() <= landscape.items()


@pytest.mark.parametrize("start", [[3, 3], [100, 5], [5, -1], [5, 9]])
def test_a_start_that_does_not_fall_is_refused(start):
    with refused("start"):
        search_timesteps(lambda timesteps: 0.0, start)


@pytest.mark.parametrize("name", ["ddim_70_20", "ddpm_70_20", "unipc3_logsnr"])
def test_the_error_is_that_of_the_executed_actions_of_the_chain(make_network, name):
    ones, zeros = (fill(5) for fill in (torch.ones, torch.zeros))
    policy = DiffusionPolicy(make_network(), Normalizer(ones, zeros, torch.ones(10), torch.zeros(10)))
    targets = TensorDict(
        {
            keys.COND: torch.randn(20, 2, 5),
            keys.SEED: torch.arange(20)[:, None],
            "target": torch.randn(20, 6, 10),
        },
        [20],
    )
    sampler = Sampler.from_name(name)
    error = demonstration_error(policy, targets, sampler, n_action_steps=3)
    policy.sampler = sampler
    actions = policy.denoise(policy.sample_noise(torch.arange(20)), targets[keys.COND])
    assert error == pytest.approx((actions - targets["target"])[:, 1:4].abs().mean().item(), rel=1e-5)
