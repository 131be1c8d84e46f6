"""The noise-prediction loss: its value, its gradient and its errors."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.training.diffusion.loss import DiffusionLoss, noise_prediction_loss


@pytest.fixture
def normalizer():
    return Normalizer(torch.full((5,), 2.0), torch.ones(5), torch.full((10,), 0.5), torch.zeros(10))


@pytest.fixture
def batch():
    data = {keys.HISTORY_STATE: torch.randn(4, 2, 5), keys.ACTION: torch.randn(4, 6, 10)}
    return TensorDict(data, [4])


def test_loss_is_the_error_of_the_predicted_noise(make_network):
    network, sampler = make_network(), Sampler()
    action, noise, cond = torch.randn(4, 6, 10), torch.randn(4, 6, 10), torch.randn(4, 2, 5)
    timestep = torch.tensor([0, 10, 50, 99])
    loss = noise_prediction_loss(network, sampler, action, cond, noise, timestep)
    rows = []
    for i, t in enumerate(timestep):
        noisy = sampler.add_noise(action[i : i + 1], noise[i : i + 1], t[None])
        rows.append((network(noisy, t, cond[i : i + 1]) - noise[i]) ** 2)
    torch.testing.assert_close(loss, torch.cat(rows).mean())


def test_module_normalises_and_draws_one_timestep_for_each_chunk(make_network, normalizer, batch):
    network = make_network()
    torch.manual_seed(5)
    loss = DiffusionLoss(network, normalizer)(batch)["loss"]
    torch.manual_seed(5)
    timestep, noise = torch.randint(100, (4,)), torch.randn(4, 6, 10)
    cond, action = batch[keys.HISTORY_STATE] * 2 + 1, batch[keys.ACTION] * 0.5
    assert torch.equal(loss, noise_prediction_loss(network, Sampler(), action, cond, noise, timestep))


def test_every_parameter_gets_a_gradient(make_network, normalizer, batch):
    network = make_network()
    DiffusionLoss(network, normalizer)(batch)["loss"].backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_chunk_of_a_wrong_shape_is_named(make_network, normalizer, batch):
    loss = DiffusionLoss(make_network(), normalizer)
    with refused("action"):
        loss(batch.set(keys.ACTION, batch[keys.ACTION][:, :5]))
