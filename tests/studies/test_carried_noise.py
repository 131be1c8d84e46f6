"""What is left of a chain's first noise."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from recipes.studies.carried_noise.chains import carried_noise
from tests.fixtures.diffusion import SIZES, make_network
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, keys

__all__ = ["make_network"]


class Predicting(torch.nn.Module):
    """A network whose clean prediction is ``right`` and ``wrong`` times the noise in its sample, if ``right`` is right."""

    def __init__(self, sampler, right, wrong):
        super().__init__()
        self.abar, self.right, self.wrong = sampler.alphas_cumprod, right, wrong

    def forward(self, sample, timestep, cond):
        abar = self.abar[timestep][:, None, None]
        noise = (sample - abar.sqrt() * self.right) / (1 - abar).sqrt()
        clean = self.right + self.wrong * noise
        return (sample - abar.sqrt() * clean) / (1 - abar).sqrt()


@pytest.fixture
def policy(make_network):
    states, actions = (SIZES[name] for name in ("cond_dim", "input_dim"))
    scales = (torch.ones(states), torch.zeros(states), torch.ones(actions), torch.zeros(actions))
    return DiffusionPolicy(make_network(), Normalizer(*scales))


@pytest.fixture
def targets(policy):
    """Four policy calls."""
    cond = torch.randn(4, policy.n_obs_steps, SIZES["cond_dim"])
    return TensorDict({keys.COND: cond, "target": torch.full((4, policy.horizon, 10), 0.1)}, [4])


def stub(sampler, wrong):
    """What is asked of a policy, with a network that predicts the targets' actions and ``wrong`` times the noise."""
    return SimpleNamespace(network=Predicting(sampler, 0.1, wrong), n_obs_steps=2)


def test_a_network_that_is_right_answers_without_noise(targets):
    sampler = Sampler("ddim", 10)
    chain = carried_noise(stub(sampler, 0.0), targets, sampler)
    assert chain.timesteps == (90, 80, 70, 60, 50, 40, 30, 20, 10, 0)
    assert max(chain.spread, chain.error) < 1e-3


@pytest.mark.parametrize(("name", "kept"), [("ddim10", True), ("ddpm10", False), ("ddpm3_logsnr", False)])
def test_deterministic_chains_keep_their_noise(targets, name, kept):
    sampler = Sampler.from_name(name)
    chain = carried_noise(stub(sampler, 0.05), targets, sampler, draws=64)
    assert chain.correlation[0] == pytest.approx(1, abs=1e-3)
    assert (chain.correlation[-1] > 0.9) == kept
    assert abs(chain.correlation[-1]) < 0.1 or kept


def test_the_answers_are_those_of_the_policy(policy, targets):
    policy.sampler, draws = Sampler("ddpm", 5), 3
    shape = (12, 5, policy.horizon, policy.network.input_dim)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(3))
    cond = targets[keys.COND].repeat_interleave(draws, 0)
    answers = policy.denoise(noise, cond).unflatten(0, (4, draws))[:, :, policy.n_obs_steps - 1 :][:, :, :2]
    chain = carried_noise(policy, targets, policy.sampler, draws=draws, seed=3, n_action_steps=2)
    assert chain.spread == pytest.approx(answers.var(1).mean().sqrt().item(), abs=1e-4)
    assert chain.error == pytest.approx((answers - 0.1).square().mean().sqrt().item(), abs=1e-4)


def test_too_few_draws_are_refused(policy, targets):
    with refused("got 2 draws of 4 calls"):
        carried_noise(policy, targets, Sampler("ddim", 2), draws=2)
