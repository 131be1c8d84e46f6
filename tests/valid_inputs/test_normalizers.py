"""Normalisers of data in which a number hardly varies, or is rarely used."""

import warnings

import pytest
import torch

from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer

LOCKED, TURN, GRIPPER = 1, 4, 6


@pytest.fixture
def data():
    """States with a joint that is locked at 0.3, and actions of poses with a turn that 5 of 1,000 steps use."""
    generator = torch.Generator().manual_seed(0)
    state = torch.rand(1000, 3, generator=generator)
    action = torch.rand(1000, 7, generator=generator) * 2 - 1
    state[:, LOCKED], action[:, TURN] = 0.3, 0
    action[:5, TURN] = 0.5
    action[:, GRIPPER] = action[:, GRIPPER].sign()
    return state, action


@pytest.mark.parametrize("value", [0.3, 0.300001, 0.299999, 0.3001])
@pytest.mark.parametrize("fit", [QuantileNormalizer.fit, Normalizer.fit])
@pytest.mark.filterwarnings("ignore:action")
def test_a_locked_joint_is_centred_and_not_stretched(data, fit, value):
    """Its rounding is no signal: Diffusion Policy's range normaliser (arXiv:2303.04137) and OpenVLA's training
    (arXiv:2406.09246, where min == max becomes 0) centre it."""
    options = {} if fit == QuantileNormalizer.fit else {"state_mode": "range", "poses": False}
    shown = fit(*data, **options).normalize_state(torch.tensor([0.5, value, 0.5]))[LOCKED].item()
    assert shown == pytest.approx(value - 0.3, abs=1e-6)


def test_a_turn_that_few_steps_use_can_be_commanded_and_is_named(data):
    """A demonstrated command survives its normaliser (huggingface/lerobot#211); the user hears which number is rare."""
    with pytest.warns(UserWarning, match="^action: numbers 4 vary in a few steps alone"):
        normalizer = QuantileNormalizer.fit(*data)
    again = normalizer.unnormalize_action(normalizer.normalize_action(data[1]))
    torch.testing.assert_close(again[:, TURN], data[1][:, TURN], atol=1e-6, rtol=0)
    assert normalizer.unnormalize_action(torch.ones(7))[TURN] == pytest.approx(0.5)


def test_a_turn_beside_a_trembling_hand_can_be_commanded(data):
    """The same where the other steps are not zero but small: quantiles of 0.001 would clip 0.5 to it."""
    state, action = data
    action[5:, TURN] = torch.rand(995) * 2e-3 - 1e-3
    with pytest.warns(UserWarning, match="numbers 4 vary"):
        normalizer = QuantileNormalizer.fit(state, action)
    assert normalizer.unnormalize_action(torch.ones(7))[TURN] == pytest.approx(0.5)


def test_a_number_that_never_varies_stays_and_ordinary_data_are_mapped_by_quantiles(data):
    """OpenVLA-OFT's formula (arXiv:2502.19645), without a word, wherever it is defined."""
    state, action = data
    action[:, TURN] = 0.25
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        normalizer = QuantileNormalizer.fit(state, action)
    low, high = (torch.quantile(action.double(), q, dim=0).float() for q in (0.01, 0.99))
    assert torch.equal(normalizer.action_low, low)
    assert torch.equal(normalizer.action_high, high)
    seen = normalizer.normalize_state(state)[:, 0]
    low, high = (torch.quantile(state[:, 0].double(), q).float() for q in (0.01, 0.99))
    assert torch.equal(seen, (2 * (state[:, 0] - low) / (high - low + 1e-8) - 1).clamp(-1, 1))
    for said in (-1.0, 0.0, 1.0):
        assert normalizer.unnormalize_action(torch.full((7,), said))[TURN] == pytest.approx(0.25, abs=1e-6)
