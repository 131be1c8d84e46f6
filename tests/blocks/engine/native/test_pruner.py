"""The pruner's MLP in compiled code against the same network in double precision."""

import copy
import pickle

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.engine.native import library
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.native.pruner import MAX_HIDDEN, NativePruner
from torchrl_sparse.blocks.sag.network import PrunerNetwork

AVAILABLE, REASON = native_available()
pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)
SETS = REASON.split(", ") if AVAILABLE else []

TO, D = 2, 23


def make_network(steps=7, num_blocks=9, cond_shape=(TO, D), **sizes):
    torch.manual_seed(0)
    network = PrunerNetwork(range(steps - 1, -1, -1), num_blocks, cond_shape, **sizes)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network.eval()


def observations(rows=5, cond_shape=(TO, D)):
    return torch.randn(rows, *cond_shape, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def exact(network, cond, rate=None):
    reference = copy.deepcopy(network).double()
    logits = reference(cond.double(), None if rate is None else rate.double())
    return (logits[..., 1] - logits[..., 0]).float()


def assert_close(got, expected):
    """Up to the rounding of sums, which is relative to the largest terms."""
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5 * expected.abs().max().item())


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"hidden": 1, "obs_width": 3, "cond_shape": (1, 1)},
        {"hidden": 45, "obs_width": 100, "steps": 1, "num_blocks": 3},
        {"hidden": MAX_HIDDEN, "width": 16, "cond_shape": (3, 150)},
    ],
    ids=["default", "one of each", "no multiple of a vector", "largest"],
)
def test_the_logits_are_those_of_the_network(instruction_set, sizes):
    network = make_network(**sizes)
    cond = observations(cond_shape=network.cond_shape)
    expected = exact(network, cond)
    with torch.no_grad():
        compiled = NativePruner(network.mlp_weights(), instruction_set)
    assert_close(compiled.logits(cond.flatten(1)), expected)
    positive = compiled.logits(cond.flatten(1)) > 0
    positive[:, 0] = False
    assert torch.equal(compiled.masks(cond.flatten(1)), positive)


@pytest.mark.parametrize("rows", [1, 16])
def test_the_network_uses_it_without_gradients_and_a_row_is_as_alone(rows):
    network = make_network(rate_input=True)
    cond, rate = observations(rows).transpose(1, 2).contiguous().transpose(1, 2), torch.rand(rows, 1)
    with torch.no_grad():
        together = network.prune_logits(cond, rate)
        alone = torch.cat([network.prune_logits(cond[i : i + 1], rate[i : i + 1]) for i in range(rows)])
    assert network._native is not None
    assert torch.equal(together, alone)
    assert_close(together, exact(network, cond, rate))


def test_a_rate_of_another_type_is_converted_and_a_missing_one_refused():
    network, rate = make_network(rate_input=True), torch.full((5, 1), 0.5)
    with torch.no_grad():
        expected = network.prune_logits(observations(), rate)
        assert torch.equal(network.prune_logits(observations(), rate.double()), expected)
        with refused("features"):
            network.prune_logits(observations())


@pytest.mark.parametrize("change", ["load_state_dict", "train", "eval", "double and back"])
def test_it_follows_the_weights(change):
    network, cond = make_network(), observations()
    with torch.no_grad():
        before = network.prune_logits(cond)
        new = {name: 2 * value for name, value in network.state_dict().items()}
        if change == "load_state_dict":
            network.load_state_dict(new)
        else:
            if change == "train":
                network.train()
            if change == "double and back":
                network.double()
            for name, parameter in network.named_parameters():
                parameter.copy_(new[name])
            network.float() if change == "double and back" else network.eval()
        after = network.prune_logits(cond)
    assert not torch.allclose(after, before)
    assert_close(after, exact(network, cond))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda network: pickle.loads(pickle.dumps(network))])
def test_a_copy_makes_its_own(duplicate):
    network, cond = make_network(), observations()
    with torch.no_grad():
        logits = network.prune_logits(cond)
        twin = duplicate(network)
        twin.mlp[3].bias[1] += 1
        assert_close(twin.prune_logits(cond), logits + 1)
        assert torch.equal(network.prune_logits(cond), logits)


@pytest.mark.parametrize("why", ["large", "double", "training", "gradients", "no library"])
def test_what_it_cannot_compute_is_left_to_pytorch(why, monkeypatch):
    network, cond = make_network(hidden=MAX_HIDDEN + (why == "large")), observations()
    expected = exact(network, cond)
    if why == "double":
        network, cond = network.double(), cond.double()
    network.train(why == "training")
    if why == "no library":
        monkeypatch.setattr(library, "library", lambda: "it was not built")
    with torch.set_grad_enabled(why == "gradients"):
        logits, masks = network.prune_logits(cond), network.prune_masks(cond)
    assert not network._native
    assert logits.requires_grad == (why == "gradients")
    assert_close(logits.float(), expected)
    assert torch.equal(masks[:, 1:], logits[:, 1:] > 0)
    assert not masks[:, 0].any()
