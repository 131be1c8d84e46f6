"""A frozen policy answers as it did, and every way of writing to its weights raises."""

import copy
import pickle

import numpy as np
import pytest
import torch
import torch.multiprocessing
from torch import nn

from torchrl_sparse import DiffusionPolicy, Sampler, keys
from torchrl_sparse.blocks.engine import ENGINES
from torchrl_sparse.networks.frozen import Frozen, FrozenError

from .test_engine_option import request

AVAILABLE = [name for name in ENGINES if name in ("reference", "torch", "native")]


@pytest.fixture
def policy(policy):
    with torch.no_grad():
        policy.network.head.bias.fill_(0.5)
    return policy


def bias(policy):
    return policy.network.head.bias


def chunk(policy):
    return policy(request(2))[keys.CHUNK]


def halved(network):
    return {name: value / 2 for name, value in network.state_dict().items()}


def an_optimiser_step(policy):
    optimiser = torch.optim.AdamW(policy.network.parameters())
    policy.network(torch.randn(1, 6, 4), 3, torch.randn(1, 2, 5)).sum().backward()
    optimiser.step()


def a_fused_optimiser_step(policy):
    optimiser = torch.optim.SGD(policy.network.parameters(), lr=0.1, fused=True)
    policy.network(torch.randn(1, 6, 4), 3, torch.randn(1, 2, 5)).sum().backward()
    optimiser.step()


@torch.no_grad()
def in_place(policy):
    bias(policy).add_(1)


def in_place_in_inference_mode(policy):
    with torch.inference_mode():
        bias(policy)[0] = 1


def a_view_in_inference_mode(policy):
    with torch.inference_mode():
        bias(policy).view(-1)[1:].mul_(2)


def a_reset(policy):
    policy.network.head.reset_parameters()


WAYS = [
    an_optimiser_step,
    a_fused_optimiser_step,
    in_place,
    in_place_in_inference_mode,
    a_view_in_inference_mode,
    a_reset,
    lambda policy: policy.network.load_state_dict(halved(policy.network)),
    lambda policy: policy.network.load_state_dict(halved(policy.network), assign=True),
    lambda policy: policy.load_state_dict(halved(policy)),
    lambda policy: policy.network.head.load_state_dict(halved(policy.network.head)),
    lambda policy: bias(policy).data.copy_(torch.ones(4)),
    lambda policy: setattr(bias(policy), "data", torch.ones(4)),
    lambda policy: bias(policy).detach().zero_(),
    lambda policy: bias(policy).data.set_(torch.ones(4)),
    lambda policy: bias(policy).data.unbind()[0].fill_(1),
    lambda policy: torch.ones(4, out=bias(policy).data),
    lambda policy: torch.add(torch.ones(4), 1, out=bias(policy).data),
    lambda policy: torch._foreach_zero_([parameter.data for parameter in policy.network.parameters()]),
    lambda policy: nn.functional.relu(bias(policy).data, inplace=True),
    lambda policy: nn.init.zeros_(bias(policy)),
    lambda policy: nn.init.kaiming_uniform_(policy.network.head.weight),
    lambda policy: torch.ops.aten.add_.Tensor(bias(policy).data, 1),
    lambda policy: policy.network.state_dict()["head.bias"].zero_(),
    lambda policy: setattr(policy.network.head, "bias", nn.Parameter(torch.ones(4))),
    lambda policy: delattr(policy.network.head, "bias"),
    lambda policy: policy.network.head._parameters.update(bias=nn.Parameter(torch.ones(4))),
    lambda policy: policy.network.head.register_parameter("other", nn.Parameter(torch.ones(4))),
    lambda policy: setattr(policy.network, "head", nn.Linear(32, 4)),
    lambda policy: policy.network.decoder.layers.__setitem__(
        0, copy.deepcopy(policy.network.decoder.layers[1])
    ),
    lambda policy: setattr(policy.module["denoise"], "network", copy.deepcopy(policy.network)),
    lambda policy: policy.to(torch.float64),
    lambda policy: policy.to("meta"),
    lambda policy: policy.half(),
    lambda policy: policy.train(),
    lambda policy: torch.utils.swap_tensors(bias(policy), nn.Parameter(torch.ones(4))),
    lambda policy: policy.normalizer.action_offset.add_(1),
    lambda policy: setattr(policy.normalizer, "action_offset", torch.ones(4)),
]


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_writing_raises_and_changes_nothing(way, policy):
    before, weights = chunk(policy.freeze()), {k: v.clone() for k, v in policy.state_dict().items()}
    with pytest.raises(RuntimeError) as error:
        way(policy)
    assert isinstance(error.value, FrozenError) or "weakref" in str(
        error.value
    )  # of swap_tensors, PyTorch's own
    assert "\n" not in str(error.value)
    assert all(torch.equal(value, weights[name]) for name, value in policy.state_dict().items())
    assert torch.equal(chunk(policy), before)


@pytest.mark.parametrize("alias", [lambda b: b.detach(), lambda b: b[1:], lambda b: b.view(2, 2)])
@pytest.mark.parametrize("engine", AVAILABLE[:2])
def test_a_write_to_what_was_taken_before_is_an_error_of_the_next_query(policy, alias, engine):
    policy.engine = engine
    with torch.no_grad():
        before = alias(bias(policy))
        policy.freeze()
        chunk(policy)
        before.add_(1)
    with pytest.raises(FrozenError, match=r"^network\.head\.bias: "):
        chunk(policy)


def test_what_was_taken_without_a_record_shares_memory_no_more(policy):
    data, array, offset = (
        bias(policy).data,
        bias(policy).detach().numpy(),
        policy.normalizer.action_offset.data,
    )
    before = chunk(policy.freeze())
    data.zero_(), array.fill(3), offset.zero_()
    policy.engine = "reference"
    torch.testing.assert_close(chunk(policy), before, atol=1e-5, rtol=0)
    assert bias(policy).count_nonzero()


def test_arrays_can_be_read_alone(policy):
    array = bias(policy.freeze()).detach().numpy()
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1
    other = np.from_dlpack(bias(policy).detach())
    assert not np.shares_memory(array, other)


@pytest.mark.parametrize("engine", AVAILABLE)
def test_it_answers_as_before_in_every_mode(policy, engine):
    policy.engine = engine
    before, fingerprint = chunk(policy), policy.fingerprint
    assert policy.freeze() is policy
    assert policy.freeze().frozen
    for mode in (torch.enable_grad, torch.no_grad, torch.inference_mode):
        with mode():
            assert torch.equal(chunk(policy), before)
    assert policy.fingerprint == fingerprint
    policy.to("cpu").float().eval()
    policy.engine, policy.noise = "reference", "philox"
    assert (chunk(policy) - before).abs().max() > 1e-3


def test_frozen_in_inference_mode_it_answers_as_before(policy):
    before = chunk(policy)
    with torch.inference_mode():
        policy.freeze()
        assert torch.equal(chunk(policy), before)
    assert torch.equal(chunk(policy), before)


def test_policies_of_the_same_networks_are_frozen_too(policy):
    before = policy.with_plan(None)
    policy.freeze()
    after, noise = policy.with_plan(None, Sampler("ddpm", 4)), policy.with_noise(1)
    assert before.frozen
    assert after.frozen
    assert noise.frozen
    assert torch.equal(chunk(before), chunk(policy))
    with pytest.raises(FrozenError):
        after.network.head.bias.data.zero_()


def reread(policy, folder):
    policy.save_pretrained(folder, half=False)
    return DiffusionPolicy.from_pretrained(folder)


@pytest.mark.parametrize(
    "copied",
    [
        lambda policy, folder: copy.deepcopy(policy),
        lambda policy, folder: pickle.loads(pickle.dumps(policy)),
        lambda policy, folder: pickle.loads(torch.multiprocessing.reducer.ForkingPickler.dumps(policy)),
        reread,
    ],
)
def test_copies_are_not_frozen(policy, copied, tmp_path):
    before = chunk(policy.freeze())
    other = copied(policy, tmp_path / "policy")
    assert not other.frozen
    assert torch.equal(chunk(other), before)
    assert all(type(part) is nn.Parameter for part in other.parameters())
    assert all(type(part) is torch.Tensor for part in other.state_dict().values())
    other.network.load_state_dict(policy.network.state_dict())
    other.train().eval().network.head.bias.data.add_(1)
    assert (chunk(other) - before).abs().max() > 1e-3
    assert torch.equal(chunk(policy), before)


def test_cameras_are_frozen_with_the_rest(make_image_policy):
    policy = make_image_policy().freeze()
    with pytest.raises(FrozenError, match=r"^vision\."):
        next(policy.vision.parameters()).data.zero_()
    assert Frozen.of(copy.deepcopy(policy.vision)) is None


def test_gradients_of_observations_still_flow(policy):
    query = request(2)
    query["history", "state"] = query["history", "state"].requires_grad_()
    policy.freeze()(query)[keys.CHUNK].sum().backward()
    assert query["history", "state"].grad.abs().sum() > 0
