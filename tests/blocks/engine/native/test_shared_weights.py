"""Engines of one network read one packing of its weights, for as long as the network lives."""

import gc
import weakref
from functools import partial

import pytest
import torch

from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.packing import PackedWeights
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.engine.native.weights import NativeWatch, SharedWeights
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion


@pytest.fixture
def network():
    sizes = {"input_dim": 7, "output_dim": 7, "horizon": 4, "n_obs_steps": 2, "cond_dim": 5}
    network = TransformerForDiffusion(**sizes, n_layer=2, n_emb=32).eval().requires_grad_(False)
    if not native_supports(network)[0]:
        pytest.skip(native_supports(network)[1])
    return network


def query(steps):
    return torch.randn(2, steps, 4, 7), torch.randn(2, 2, 5)


def packings(monkeypatch):
    made = []

    class Counted(PackedWeights):
        def __init__(self, network, dtype):
            made.append(dtype)
            super().__init__(network, dtype)

    monkeypatch.setattr("torchrl_sparse.blocks.engine.native.weights.PackedWeights", Counted)
    return made


def test_samplers_share_one_packing_of_each_type_and_a_change_makes_one_more(network, monkeypatch):
    made = packings(monkeypatch)
    engines = [NativeEngine(network, Sampler("ddim", steps)) for steps in (2, 5)]
    engines.append(NativeEngine(network, Sampler("ddim", 2), weights="bfloat16"))
    assert made == [torch.float32, torch.bfloat16]
    network.head.bias.add_(0.5)
    for engine, steps in zip(engines, (2, 5, 2), strict=True):
        engine.denoise(*query(steps))
    assert made == [torch.float32, torch.bfloat16] * 2


def test_an_engine_beside_others_answers_as_it_does_alone(network):
    noise, cond = query(5)
    alone = NativeEngine(network, Sampler("ddim", 5)).denoise(noise, cond)
    beside = [NativeEngine(network, Sampler("ddpm", steps)) for steps in (3, 5)]
    for engine, steps in zip(beside, (3, 5), strict=True):
        engine.denoise(*query(steps))
    assert torch.equal(NativeEngine(network, Sampler("ddim", 5)).denoise(noise, cond), alone)


@pytest.mark.parametrize("instruction_set", [None, "portable"])
def test_weights_that_are_half_precision_numbers_are_read_as_such_without_a_bit_lost(
    network, monkeypatch, instruction_set
):
    for parameter in network.parameters():
        parameter.copy_(parameter.half())
    engine = NativeEngine(network, Sampler("ddim", 5), instruction_set=instruction_set)
    noise, cond = query(5)
    narrow = engine.denoise(noise, cond)
    wide = partial(PackedWeights, narrow=False)
    monkeypatch.setattr("torchrl_sparse.blocks.engine.native.weights.PackedWeights", wide)
    engine.refresh()
    assert torch.equal(engine.denoise(noise, cond), narrow)
    types = [
        PackedWeights(network, torch.float32, narrow=n).members["layer"][0].kv.type for n in (True, False)
    ]
    assert types == [1, 0]  # F16 and F32 of layout.h


def test_nothing_shared_keeps_a_network_alive(network):
    sizes = {"input_dim": 7, "output_dim": 7, "horizon": 4, "n_obs_steps": 2, "cond_dim": 5}
    other = TransformerForDiffusion(**sizes, n_layer=1, n_emb=16).eval().requires_grad_(False)
    engine = NativeEngine(other, Sampler("ddim", 2))
    shared, gone = weakref.ref(SharedWeights.of(other, torch.float32)), weakref.ref(other)
    del engine, other
    gc.collect()
    assert gone() is None
    assert shared() is None


def test_a_watch_does_not_outlive_its_network():
    watch = NativeWatch(torch.nn.Linear(2, 2))
    gc.collect()
    with pytest.raises(ReferenceError, match="network: expected one that is still in use"):
        _ = watch.network
