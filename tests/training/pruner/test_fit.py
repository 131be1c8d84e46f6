"""Gates are fitted to masks, each at its own rate, and stay where gradients reach them."""

import pytest
import torch

from tests.blocks.conftest import NUM_STEPS
from tests.refusals import refused
from tests.training.pruner.conftest import NUM_BLOCKS, sag_gates
from torchrl_sparse import keys
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.blocks.sag.planner import rate_threshold
from torchrl_sparse.training.pruner.fit import fit_to_masks, spread_logits


@pytest.mark.parametrize("rate_input", [False, True])
def test_gates_are_fitted_to_a_mask(policy, targets, rate_input):
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.5
    mask[0] = False
    gates = sag_gates(policy, rate_input=rate_input)
    fit_to_masks(gates, [mask], targets, updates=1200)
    cond = targets[keys.COND][:5]
    rate = torch.full((5, 1), prune_rate(mask).item()) if rate_input else None
    logits = gates.prune_logits(cond, rate)[:, 1:]
    assert ((logits > 0) == mask[1:]).float().mean() > 0.98
    assert logits.abs().max() < 4  # or gradients would not reach them
    with refused("mask"):
        fit_to_masks(gates, [mask[1:]], targets)


def test_gates_are_fitted_to_a_mask_for_each_of_several_rates(policy, targets):
    generator = torch.Generator().manual_seed(1)
    masks = [torch.rand(NUM_STEPS, NUM_BLOCKS, generator=generator) < rate for rate in (0.3, 0.7)]
    for mask in masks:
        mask[0] = False
    gates = sag_gates(policy, rate_input=True)
    fit_to_masks(gates, masks, targets, updates=600)
    cond = targets[keys.COND][:5]
    for mask in masks:
        rate = torch.full((5, 1), prune_rate(mask).item())
        logits = gates.prune_logits(cond, rate)
        pruned = logits[:, 1:] > rate_threshold(logits, rate)
        assert (pruned == mask[1:]).float().mean() > 0.9
    with refused("masks"):
        fit_to_masks(sag_gates(policy), masks, targets)
    with refused("masks"):
        fit_to_masks(gates, [], targets)


@pytest.mark.parametrize("rate_input", [False, True])
def test_gates_begin_with_masks_that_differ_between_observations(policy, targets, rate_input):
    gates = sag_gates(policy, rate_input=rate_input)
    targets[keys.COND][..., 0] = 3.0  # what is constant tells nothing
    targets[keys.COND][..., 1:] *= 1e-2  # as states are that one number scales
    spread_logits(gates, targets, 0.8)
    rate = torch.full((len(targets), 1), 0.5) if rate_input else None
    logits = gates.prune_logits(targets[keys.COND], rate)[:, 1:]
    assert logits.std(dim=0).mean().item() == pytest.approx(0.8, rel=0.05)
    assert logits.mean().item() == pytest.approx(0, abs=1e-3)
    masks = logits > 0
    assert 0.3 < masks.float().mean() < 0.7
    changing = masks.float().mean(dim=0)
    assert ((changing > 0.1) & (changing < 0.9)).float().mean() > 0.5
