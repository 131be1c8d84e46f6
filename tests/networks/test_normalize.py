"""The published normalisation, its inverse, and data that it refuses."""

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.networks.normalize import Normalizer


@pytest.fixture
def data():
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(50, 6, generator=generator) * torch.tensor([0.01, 1, 2, 3, 4, 5.0])
    return state, torch.rand(50, 20, generator=generator) * 0.4 + 0.3


def test_states_share_one_scale_and_no_offset(data):
    state, action = data
    normalizer = Normalizer.fit(state, action)
    torch.testing.assert_close(normalizer.normalize_state(state), state / state.abs().max())
    assert normalizer.normalize_state(state).abs().max().item() == pytest.approx(1)


def test_range_mode_fills_every_dimension(data):
    state, action = data
    normal = Normalizer.fit(state, action, state_mode="range").normalize_state(state)
    torch.testing.assert_close(normal.amin(0), -torch.ones(6))
    torch.testing.assert_close(normal.amax(0), torch.ones(6))


def test_positions_of_each_arm_fill_the_range_and_the_rest_is_kept(data):
    state, action = data
    normal = Normalizer.fit(state, action).normalize_action(action)
    position = [0, 1, 2, 10, 11, 12]
    torch.testing.assert_close(normal[:, position].amin(0), -torch.ones(6))
    torch.testing.assert_close(normal[:, position].amax(0), torch.ones(6))
    rest = [i for i in range(20) if i not in position]
    assert torch.equal(normal[:, rest], action[:, rest])


def test_unnormalising_inverts(data):
    state, action = data
    normalizer = Normalizer.fit(state, action)
    torch.testing.assert_close(normalizer.unnormalize_action(normalizer.normalize_action(action)), action)
    chunk = action.reshape(5, 10, 20)
    torch.testing.assert_close(normalizer.unnormalize_action(normalizer.normalize_action(chunk)), chunk)


@pytest.mark.parametrize("mode", ["global", "range"])
def test_constant_dimensions_stay_finite(mode):
    normalizer = Normalizer.fit(torch.zeros(4, 3), torch.full((4, 10), 0.7), state_mode=mode)
    assert torch.equal(normalizer.normalize_state(torch.zeros(1, 3)), torch.zeros(1, 3))
    assert torch.equal(normalizer.normalize_action(torch.full((1, 10), 0.7))[:, :3], torch.zeros(1, 3))


def test_state_dict_rebuilds_it(data):
    normalizer = Normalizer.fit(*data)
    again = Normalizer(**normalizer.state_dict())
    assert torch.equal(again.normalize_state(data[0]), normalizer.normalize_state(data[0]))


def test_bad_data_is_named(data):
    state, action = data
    with refused("state_mode"):
        Normalizer.fit(state, action, state_mode="mean")
    with refused("action"):
        Normalizer.fit(state, action[:, :7])
    with refused("state, action"):
        Normalizer.fit(state, action[1:])
    state[3, 2] = torch.nan
    with refused("state"):
        Normalizer.fit(state, action)


def test_bad_constants_are_named():
    one, zero = torch.ones(3), torch.zeros(3)
    with refused("action_scale, action_offset"):
        Normalizer(one, zero, one, zero[:2])
    with refused("state_scale, state_offset"):
        Normalizer(zero, zero, one, zero)
