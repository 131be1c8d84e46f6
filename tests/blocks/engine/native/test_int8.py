"""8-bit weights and activations against the same rounding, written out in PyTorch."""

from types import MethodType

import pytest
import torch
from torch.nn import functional

from torchrl_sparse.blocks.engine.folding import fold_layers
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.networks.diffusion.sampler import Sampler

from .test_engine import AVAILABLE, REASON, SETS, exact, make_network, make_query

pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)


def product(x, weight, bias):
    """Round a weight by output and an activation by token, multiply whole numbers."""
    weight, bias = weight.reshape(-1, x.shape[-1]), bias.reshape(-1)
    scale = weight.abs().amax(dim=1) / 127
    low, high = x.amin(-1, keepdim=True).clamp(max=0), x.amax(-1, keepdim=True).clamp(min=0)
    step = (high - low) / 255
    zero = (0.5 - low / step).floor()
    levels = (x / step + zero + 0.5).floor().clamp(0, 255)
    return step * scale * ((levels - zero) @ (weight / scale[:, None]).round().T) + bias


def round_to_int8(network):
    """Let self-attention and the feed-forward network of ``network`` multiply rounded numbers; cross-attention stays."""
    layers, block = fold_layers(network), network.block

    def rounded(self, index, x, memory):
        layer, kind = layers[index // 3], index % 3
        if kind == 1:
            return block(index, x, memory)
        y = functional.layer_norm(x, x.shape[-1:])
        if kind == 2:
            return product(functional.gelu(product(y, *layer.up)), *layer.down)
        query, key, value = (
            product(y, *layer.qkv).unflatten(-1, (3, self.n_head, -1)).permute(2, 0, 3, 1, 4).unbind()
        )
        scores = query @ key.mT + (self.mask if self.mask is not None else 0)
        return product((scores.softmax(-1) @ value).transpose(1, 2).flatten(2), *layer.out)

    network.block = MethodType(rounded, network)
    return network


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize(
    "shape", ["lift", "kitchen", "more than one part", "no multiple of a vector", "not causal"]
)
def test_rounds_as_written_out(shape, instruction_set):
    network, sampler = make_network(shape), Sampler("ddim", 4)
    noise, cond, mask = make_query(network, sampler, batch=4, rate=0.3)
    actions = NativeEngine(network, sampler, weights="int8", instruction_set=instruction_set).denoise(
        noise, cond, mask
    )
    unrounded = exact(network, sampler, noise, cond, mask)
    expected = exact(round_to_int8(network), sampler, noise, cond, mask)
    rounding = (expected - unrounded).abs().mean()
    assert 1e-5 < rounding < 1e-2
    # Where f32 and f64 lie on two sides of half a level, they differ by one: rarely.
    assert (actions - expected).abs().mean() < rounding / 10


def test_what_is_no_number_comes_out_as_none():
    network, sampler = make_network("lift"), Sampler("ddim", 4)
    noise, cond, _ = make_query(network, sampler, batch=1)
    noise[0, 0, 3] = torch.nan
    assert NativeEngine(network, sampler, weights="int8").denoise(noise, cond)[0, 3].isnan().all()


def test_columns_without_weights_add_their_bias():
    network, sampler = make_network("lift"), Sampler("ddim", 4)
    for layer in network.decoder.layers:
        layer.linear2.weight.zero_()
        layer.self_attn.out_proj.weight.zero_()
    noise, cond, _ = make_query(network, sampler)
    error = NativeEngine(network, sampler, weights="int8").denoise(noise, cond) - exact(
        network, sampler, noise, cond
    )
    assert error.abs().max() < 1e-5
