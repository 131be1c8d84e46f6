"""The transformer with adaptive layer norms is what its equations say, and its modulation separates."""

import pytest
import torch
from torch.nn import functional

from tests.refusals import refused
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer, rotary_angles, rotate

SIZES = {
    "input_dim": 3,
    "horizon": 6,
    "n_obs_steps": 2,
    "cond_dim": 5,
    "n_layer": 2,
    "n_head": 2,
    "n_emb": 16,
    "time_dim": 8,
}


def make(**changes):
    torch.manual_seed(0)
    network = AdaLNTransformer(**SIZES | changes).eval().double()
    for layer in network.transformer_blocks:
        torch.nn.init.normal_(layer.modulation.weight, std=0.3)
    return network


@pytest.mark.parametrize(
    "changes", [{}, {"rope_base": None}, {"positions": True}, {"rope_base": None, "positions": True}]
)
@torch.no_grad()
def test_it_computes_its_equations(changes):
    network = make(**changes)
    sample, cond = torch.randn(4, 6, 3).double(), torch.randn(4, 2, 5).double()
    time = network.time_mlp(torch.full((4,), 7.0).double())
    features = functional.silu(torch.cat([time, cond.flatten(1)], 1))
    x = network.input_proj(sample)
    if network.positions:
        x = x + network.pos_embedding
    for layer in network.transformer_blocks:
        parts = layer.modulation(features)[:, None].chunk(6, dim=-1)
        y = functional.layer_norm(x, (16,), eps=1e-6) * (1 + parts[1]) + parts[0]
        q, k, v = (part.view(4, 6, 2, 8).transpose(1, 2) for part in layer.attn["qkv_proj"](y).chunk(3, -1))
        if network.rope_base is not None:
            q, k = turned(q), turned(k)
        weights = (q @ k.mT / 8**0.5).softmax(-1)
        x = x + parts[2] * layer.attn["out_proj"]((weights @ v).transpose(1, 2).flatten(2))
        y = functional.layer_norm(x, (16,), eps=1e-6) * (1 + parts[4]) + parts[3]
        x = x + parts[5] * layer.mlp(y)
    torch.testing.assert_close(network(sample, 7, cond), network.output_proj(x), atol=1e-6, rtol=0)


def turned(x):
    """Turn each pair (j, j + size / 2) as a complex number."""
    half = x.shape[-1] // 2
    angle = torch.arange(x.shape[-2])[:, None] * 10000.0 ** (-torch.arange(half) / half)
    pair = torch.complex(x[..., :half], x[..., half:]) * torch.polar(torch.ones_like(angle), angle)
    return torch.cat([pair.real, pair.imag], -1)


@torch.no_grad()
def test_its_modulation_is_a_part_of_time_and_one_of_the_observations():
    network, cond = make(), torch.randn(3, 2, 5).double()
    apart = network.time_modulation(torch.tensor([3])) + network.observation_modulation(cond)
    torch.testing.assert_close(apart, network.memory(3, cond), atol=1e-12, rtol=0)


def test_products_of_turned_vectors_follow_from_their_distance():
    cos, sin = rotary_angles(8, 4, 100.0)
    query, key = (rotate(torch.randn(4).expand(8, 4), cos, sin) for _ in range(2))
    scores = query @ key.T
    torch.testing.assert_close(scores[2, 1], scores[6, 5])


def test_untrained_blocks_add_nothing():
    network = AdaLNTransformer(**SIZES)
    x = torch.randn(2, 6, 16)
    assert not network.block(0, x, network.memory(0, torch.randn(2, 2, 5))).any()


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"n_layer": 0}, "n_layer"),
        ({"n_head": 3}, "n_emb"),
        ({"n_head": 16}, "n_emb"),
        ({"rope_base": 0.0}, "rope_base"),
        ({"rope_base": True}, "rope_base"),
        ({"positions": 1}, "positions"),
        ({"time_dim": 7}, "dim"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(changes, entry):
    with refused(entry):
        AdaLNTransformer(**SIZES | changes)
