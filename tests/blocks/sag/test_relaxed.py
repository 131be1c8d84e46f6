"""Gates that gradients flow to: same values as the reference engine, right gradients, bounded memory."""

import pytest
import torch

from tests.blocks.conftest import NUM_LAYERS, NUM_STEPS, random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.sag.relaxed import (
    denoise_relaxed,
    gumbel_gate,
    step_errors,
    straight_through_gate,
)

NUM_BLOCKS = 3 * NUM_LAYERS


def gate_of(mask):
    return mask.double().requires_grad_()


@pytest.fixture
def double_query(network, query):
    network.double()
    return tuple(tensor.double() for tensor in query)


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
@pytest.mark.parametrize("explore", [1.0, 0.3])
def test_values_are_those_of_the_reference(network, sampler, query, reuse, explore):
    mask = random_mask(5, rate=0.7)
    expected = denoise(network, sampler, *query, mask, reuse=reuse)
    actions = denoise_relaxed(network, sampler, *query, mask.float(), reuse=reuse, explore=explore)
    torch.testing.assert_close(actions, expected, rtol=0, atol=1e-5)


def test_no_gate_is_dense(network, sampler, query):
    gate = torch.zeros(5, NUM_STEPS, NUM_BLOCKS)
    assert torch.equal(denoise_relaxed(network, sampler, *query, gate), denoise(network, sampler, *query))


@pytest.mark.parametrize("reuse", ["block", "type"])
def test_the_gradient_is_that_of_the_mixture(network, sampler, double_query, reuse):
    """Against finite differences of a chain that mixes with real gates, written out naively."""
    noise, cond = double_query
    mask = random_mask(5, rate=0.6)
    gate = gate_of(mask)
    denoise_relaxed(network, sampler, noise, cond, gate, reuse=reuse).square().sum().backward()
    step = 1e-6
    for cell in [(0, 1, 0), (1, 3, 2), (2, 5, 4), (3, 9, 5), (4, 2, 1)]:
        ahead, behind = mask.double(), mask.double()
        ahead[cell] += step
        behind[cell] -= step
        values = [
            mixed_chain(network, sampler, noise, cond, gates, reuse).square().sum()
            for gates in (ahead, behind)
        ]
        slope = ((values[0] - values[1]) / (2 * step)).item()
        assert gate.grad[cell].item() == pytest.approx(slope, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("reuse", ["block", "type"])
def test_a_detached_gate_learns_from_its_own_place_alone(network, sampler, double_query, reuse):
    """Against finite differences of a chain in which what is kept for reuse stays as it was."""
    noise, cond = double_query
    mask = random_mask(5, rate=0.6)
    gate = gate_of(mask)
    options = {"reuse": reuse, "detached": True}
    actions = denoise_relaxed(network, sampler, noise, cond, gate, **options)
    assert torch.equal(actions, denoise_relaxed(network, sampler, noise, cond, gate, reuse=reuse))
    actions.square().sum().backward()
    kept = []
    mixed_chain(network, sampler, noise, cond, mask.double(), reuse, kept)
    step = 1e-6
    for cell in [(0, 1, 0), (1, 3, 2), (2, 5, 4), (3, 9, 5), (4, 2, 1)]:
        values = []
        for sign in (1, -1):
            moved = mask.double()
            moved[cell] += sign * step
            values.append(
                mixed_chain(network, sampler, noise, cond, moved, reuse, kept=list(kept), replay=True)
            )
        slope = ((values[0].square().sum() - values[1].square().sum()) / (2 * step)).item()
        assert gate.grad[cell].item() == pytest.approx(slope, rel=1e-4, abs=1e-6)


def mixed_chain(network, sampler, noise, cond, gate, reuse, kept=None, replay=False):
    """`kept` takes what each block keeps for reuse, or gives it, with `replay`."""
    slots = {"block": NUM_BLOCKS, "type": 3}[reuse]
    latest, sample, cleans = [None] * slots, noise[:, 0], ()
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        x, memory = network.embed(sample), network.memory(timestep, cond)
        for block in range(NUM_BLOCKS):
            fresh, slot = network.block(block, x, memory), block % slots
            pruned = gate[:, k, block, None, None]
            output = fresh if k == 0 else pruned * latest[slot] + (1 - pruned) * fresh
            x = x + output
            if kept is not None and not replay:
                kept.append(output)
            latest[slot] = kept.pop(0) if replay else output
        noise_k = noise[:, k + 1] if k + 1 < NUM_STEPS else None
        eps, before = network.head_out(x), sample
        sample = sampler.step(eps, k, before, noise_k, cleans)
        cleans = sampler.remember(cleans, eps, k, before)
    return sample


def test_checkpointing_changes_nothing(network, sampler, query):
    gates = [random_mask(5).float().requires_grad_() for _ in range(2)]
    for gate, checkpointed in zip(gates, (False, True), strict=True):
        torch.manual_seed(7)
        actions = denoise_relaxed(network, sampler, *query, gate, explore=0.5, checkpointed=checkpointed)
        actions.sum().backward()
    assert torch.equal(gates[0].grad, gates[1].grad)


def test_exploring_some_blocks_has_the_gradient_of_exploring_all_on_average(network, ddpm, double_query):
    mask = random_mask(5, rate=0.8)
    full = gate_of(mask)
    step_errors(network, ddpm, *double_query, full).sum().backward()
    gates = []
    for seed in range(40):
        torch.manual_seed(seed)
        gate = gate_of(mask)
        step_errors(network, ddpm, *double_query, gate, explore=0.5).sum().backward()
        gates.append(gate.grad)
    samples = torch.stack(gates)
    error = (samples.mean(dim=0) - full.grad).abs()
    spread = samples.std(dim=0) / len(gates) ** 0.5
    # In the last block of a step nothing else that is drawn plays a part: the mean is exactly unbiased there.
    assert (error[..., -1] <= 5 * spread[..., -1] + 1e-9).all()
    assert (samples[:, mask] == 0).any()
    assert (samples[:, :, 1:][:, ~mask[:, 1:]] != 0).all()


def test_cut_steps_have_no_gradient_from_later_ones(network, sampler, query):
    gate = random_mask(5, rate=0.6).float().requires_grad_()
    errors = step_errors(network, sampler, *query, gate)
    assert errors.shape == (5, NUM_STEPS - 1, *query[0].shape[2:])
    errors[:, 4].sum().backward()  # what step 5 does wrong
    touched = gate.grad.abs().sum(dim=(0, 2)) > 0
    assert touched.nonzero().flatten().tolist() == [5]


def test_the_error_of_a_dense_step_is_zero(network, sampler, query):
    errors = step_errors(network, sampler, *query, torch.zeros(5, NUM_STEPS, NUM_BLOCKS))
    assert errors.abs().max() < 1e-6


def test_straight_through_gates_are_hard_with_the_gradient_of_the_sigmoid():
    logits = torch.randn(3, NUM_STEPS, NUM_BLOCKS, requires_grad=True)
    gate = straight_through_gate(logits)
    assert torch.equal(gate[:, 1:], (logits[:, 1:] > 0).float())
    assert not gate[:, 0].any()
    gate.sum().backward()
    probability = logits.sigmoid()
    slope = probability * (1 - probability)
    torch.testing.assert_close(logits.grad[:, 1:], slope[:, 1:].detach())
    assert not logits.grad[:, 0].any()


def test_gumbel_gates_are_drawn_with_the_probability_of_the_sigmoid():
    torch.manual_seed(0)
    logits = torch.tensor([-1.0, 0.0, 2.0]).expand(20000, 2, 3)
    rate = gumbel_gate(logits, temperature=0.5)[:, 1].mean(dim=0)
    torch.testing.assert_close(rate, logits[0, 0].sigmoid(), rtol=0, atol=0.02)


@pytest.mark.parametrize("explore", [0.0, 1.5])
def test_explore_is_a_probability(network, ddpm, query, explore):
    gate = torch.zeros(5, NUM_STEPS, NUM_BLOCKS)
    with refused("explore"):
        denoise_relaxed(network, ddpm, *query, gate, explore=explore)
