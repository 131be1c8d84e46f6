"""Weights that change are never answered with old ones, in any engine, however they change."""

import copy

import pytest
import torch
from torch import nn

from tests.refusals import refused
from torchrl_sparse.blocks.engine import ENGINES, denoise, make_engine
from torchrl_sparse.blocks.engine.native import engine as native, weights as native_weights
from torchrl_sparse.blocks.engine.torch import engine as torch_engine
from torchrl_sparse.networks.diffusion.sampler import Sampler

KEEPING = ["torch", "native"]  # engines that prepare weights and keep what they made


def engine_of(name, network):
    if not ENGINES[name].applies(network)[0]:
        pytest.skip(ENGINES[name].applies(network)[1])
    return make_engine(name, network, Sampler("ddpm", 10))


def assert_current(engine, network, query, before):
    actions, expected = engine.denoise(*query), denoise(network, Sampler("ddpm", 10), *query)
    torch.testing.assert_close(actions, expected, atol=2e-5, rtol=1e-4)
    assert (actions - before).abs().max() > 1e-3


def an_element_in_place(network):
    network.decoder.layers[1].linear1.weight[3, 5] += 3.0


def an_optimiser_step(network):
    network.requires_grad_(True)
    optimiser = torch.optim.AdamW(network.parameters(), lr=0.1)
    network(torch.randn(1, 6, 4), 3, torch.randn(1, 2, 5)).square().sum().backward()
    optimiser.step()
    network.requires_grad_(False)


def a_state_dict(network):
    network.load_state_dict({name: 1.2 * value for name, value in network.state_dict().items()})


def an_assigned_state_dict(network):
    network.load_state_dict({name: 1.2 * value for name, value in network.state_dict().items()}, assign=True)


def another_parameter(network):
    layer = network.decoder.layers[0].linear2
    layer.bias = nn.Parameter(3 * layer.bias, requires_grad=False)


def another_module(network):
    other = copy.deepcopy(network.decoder.layers[1])
    other.linear2.bias *= 3
    network.decoder.layers[1] = other


def another_tensor_behind_a_parameter(network):
    network.head.bias.data = network.head.bias.data + 1.0


def an_average_copied_through_data(network):
    for parameter in network.parameters():  # as diffusers' EMAModel.copy_to does
        parameter.data.copy_(1.2 * parameter)


def a_matrix_turned_where_it_lies(network):
    weight = network.decoder.layers[0].self_attn.out_proj.weight
    weight.data = weight.data.t()


def a_parameter_put_into_its_place_quietly(network):
    holder = network.decoder.layers[0].linear2._parameters
    holder["bias"] = nn.Parameter(3 * holder["bias"], requires_grad=False)


def two_tensors_swapped(network):
    torch.utils.swap_tensors(network.head.bias, nn.Parameter(network.head.bias + 1, requires_grad=False))


def other_values_in_the_same_storage(network):
    moved = network.head.bias + 1
    storage = network.head.bias.untyped_storage()
    storage.resize_(2 * storage.nbytes())
    network.head.bias.data = torch.empty(0).set_(storage, len(moved), moved.shape).copy_(moved)


WAYS = [
    an_element_in_place,
    an_optimiser_step,
    a_state_dict,
    an_assigned_state_dict,
    another_parameter,
    another_module,
    another_tensor_behind_a_parameter,
    an_average_copied_through_data,
    a_matrix_turned_where_it_lies,
    a_parameter_put_into_its_place_quietly,
    two_tensors_swapped,
    other_values_in_the_same_storage,
]


@pytest.mark.parametrize("name", ["reference", *KEEPING])
@pytest.mark.parametrize("way", WAYS)
def test_a_change_is_noticed(way, name, network, query):
    engine = engine_of(name, network)
    for _ in range(3):  # the third question is answered from what the second has left
        before = engine.denoise(*query)
    way(network)
    assert_current(engine, network, query, before)


@pytest.mark.parametrize("name", ["reference", *KEEPING])
def test_a_change_of_any_single_parameter_is_noticed(name, network, query):
    engine = engine_of(name, network)
    for parameter in network.parameters():
        before = engine.denoise(*query)
        parameter.add_(0.5 * torch.randn(parameter.shape))
        changed = engine.denoise(*query)
        torch.testing.assert_close(
            changed, denoise(network, Sampler("ddpm", 10), *query), atol=2e-5, rtol=1e-3
        )
        assert not torch.equal(changed, before)


@pytest.mark.parametrize("name", ["reference", *KEEPING])
def test_after_any_write_through_data_refresh_reads_anew(name, network, query):
    engine = engine_of(name, network)
    before = engine.denoise(*query)
    network.decoder.layers[1].linear2.bias.data[20:] += 1.0
    engine.refresh()
    assert_current(engine, network, query, before)


@pytest.mark.parametrize("name", KEEPING)
def test_weights_that_stay_are_not_prepared_again(name, network, query, monkeypatch):
    network.head.bias[0] = float("nan")  # equal to nothing, not even to itself
    engine = engine_of(name, network)
    monkeypatch.setattr(native, "PackedNetwork", None)
    monkeypatch.setattr(native_weights, "PackedWeights", None)
    monkeypatch.setattr(torch_engine, "Tables", None)
    assert engine.denoise(*query).isnan().any()


@pytest.mark.parametrize("name", ["reference", *KEEPING])
def test_weights_without_values_are_refused_by_name(name, network, query):
    engine = engine_of(name, network)
    engine.denoise(*query)
    network.decoder.layers[1].linear2.to("meta")
    with refused("network"):
        engine.denoise(*query)
    with pytest.raises(ValueError, match=r"on the meta device|the network is on meta"):
        make_engine(name, network.to("meta"), Sampler("ddpm", 10))
