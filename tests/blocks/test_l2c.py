"""Learning-to-Cache's own objective against the reference engine's blocks."""

import pytest
import torch

from tests.blocks.conftest import ACTION_DIM, COND_DIM, HORIZON, NUM_LAYERS, OBS_STEPS
from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.blocks.l2c import noise_errors
from torchrl_sparse.networks.diffusion.sampler import Sampler


@pytest.fixture
def query():
    """Clean actions [3, H, A], noise [3, 2, H, A] and condition [3, To, D]."""
    generator = torch.Generator().manual_seed(1)
    clean = torch.rand(3, HORIZON, ACTION_DIM, generator=generator) * 2 - 1
    noise = torch.randn(3, 2, HORIZON, ACTION_DIM, generator=generator)
    return clean, noise, torch.randn(3, OBS_STEPS, COND_DIM, generator=generator)


def predicted(network, sampler, before, noise, cond, mask):
    """What the engine predicts in the second of two steps that begin at `before`."""
    recorder = FeatureRecorder()
    denoise(network, sampler, torch.stack([before, noise], dim=1), cond, mask, record=recorder)
    first, second = recorder.features().sum(dim=0)
    eps = network.head_out(network.embed(before) + first)
    sample = sampler.step(eps, 0, before, noise)
    return network.head_out(network.embed(sample) + second)


@pytest.mark.parametrize("kind", ["ddpm", "ddim"])
def test_hard_gates_err_as_the_engine_does_right_after_a_dense_step(network, query, kind):
    clean, noise, cond = query
    chain = Sampler(kind, timesteps=[80, 55, 30])
    gate = (torch.rand(3, 3 * NUM_LAYERS, generator=torch.Generator().manual_seed(2)) < 0.5).float()
    errors = noise_errors(network, chain, clean, noise, cond, gate, step=2)
    pair = Sampler(kind, timesteps=[55, 30])
    before = chain.add_noise(clean, noise[:, 0], torch.full((3,), 55))
    mask = torch.stack([torch.zeros_like(gate), gate], dim=1).bool()
    pruned, dense = (
        predicted(network, pair, before, noise[:, 1], cond, masks) for masks in (mask, torch.zeros_like(mask))
    )
    torch.testing.assert_close(errors, pruned - dense, atol=1e-5, rtol=0)
    assert errors.abs().max() > 1e-3


@pytest.mark.parametrize("name", ["ddim", "ddpm", "unipc"])
def test_open_gates_make_no_error_and_have_a_gradient(network, query, name):
    clean, noise, cond = query
    gate = torch.zeros(3, 3 * NUM_LAYERS, requires_grad=True)
    errors = noise_errors(network, Sampler(name, 10), clean, noise, cond, gate, step=5)
    assert errors.abs().max() < 1e-5
    errors.sum().backward()
    assert (gate.grad != 0).all()
