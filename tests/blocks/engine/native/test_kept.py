"""What is kept of weights in memory changes when they do, and is not trusted where it does not."""

from itertools import pairwise

import pytest
import torch
from torch import nn

from torchrl_sparse.blocks.engine.native import kept
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.native.weights import NativeWatch
from torchrl_sparse.blocks.engine.weights import Members, WeightWatch

pytestmark = pytest.mark.skipif(not native_available()[0], reason=native_available()[1])


@pytest.fixture
def watch():
    network = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2))
    watch = NativeWatch(network)
    watch.held = network
    return watch


def test_the_layout_of_this_python_and_pytorch_is_known(watch):
    assert kept.layout_is_known()


def test_it_is_known_whatever_the_mode_of_whoever_asks_first(watch):
    with torch.inference_mode(), torch.device("meta"):
        assert kept.layout_is_known.__wrapped__()
    torch.set_default_dtype(torch.float64)
    try:
        assert kept.layout_is_known.__wrapped__()
    finally:
        torch.set_default_dtype(torch.float32)


def test_a_layout_in_which_a_change_is_not_seen_is_not_trusted(watch, monkeypatch):
    monkeypatch.setattr(kept, "_CHANGES", [*kept._CHANGES, lambda module: None])
    assert not kept.layout_is_known.__wrapped__()


def test_a_layout_whose_pointers_lie_elsewhere_is_not_followed(watch, monkeypatch):
    words = kept._words
    monkeypatch.setattr(kept, "_words", lambda place, first, last: words(place, first - 1, last - 1))
    monkeypatch.setattr(kept, "_place_of_tensor", kept._place_of_tensor.__wrapped__)
    monkeypatch.setattr(kept, "Kept", None)  # would follow them
    assert not kept.layout_is_known.__wrapped__()


def test_weights_that_stay_are_asked_one_by_one_twice_and_never_again(watch, monkeypatch):
    first, second = watch.state(), watch.state()
    assert first == second
    monkeypatch.setattr(WeightWatch, "state", None)
    assert watch.state() is second
    with torch.no_grad():
        watch.held[0](torch.ones(1, 3))
    assert watch.state() is second


def test_values_that_lie_elsewhere_by_now_are_not_read(watch):
    members, bias = Members.of(watch.held), watch.held[0].bias
    begins = [parameter.data_ptr() for parameter in members.parameters]
    assert kept.Kept(members, begins, kept.addresses(begins)).is_same()
    bias.data = bias.data.clone()
    assert not kept.Kept(members, begins, kept.addresses([8])).is_same()  # an address that nobody may read


def test_a_weight_without_storage_is_looked_at_without_following_it(watch):
    members, sparse = Members.of(watch.held), nn.Parameter(watch.held[0].bias.detach().to_sparse())
    begins = [parameter.data_ptr() for parameter in members.parameters]
    before = kept.Kept(members, begins, kept.addresses(begins))
    torch.utils.swap_tensors(watch.held[0].bias, sparse)
    assert not before.is_same()
    assert not kept.Kept(members, begins, kept.addresses(begins)).is_same()


@pytest.mark.parametrize("inference", [False, True])
def test_values_that_are_no_numbers_are_the_same_as_themselves(inference):
    with torch.inference_mode(inference):  # whose tensors count no versions
        network = nn.Linear(2, 2)
        network.weight.data.fill_(float("nan"))
    watch = NativeWatch(network)
    states = [watch.state() for _ in range(4)]
    assert states[3] is states[2] is states[1]
    network.weight.data.zero_()
    assert watch.state() != states[3]


def test_a_network_that_is_never_the_same_is_seen_every_time(watch):
    seen = [watch.state()]
    for change in range(6):
        with torch.no_grad():
            watch.held[2].bias[0] = change
        seen.append(watch.state())
    watch.refresh()
    seen += [watch.state()]
    assert all(before != after for before, after in pairwise(seen))
    assert watch.state() == seen[-1]
