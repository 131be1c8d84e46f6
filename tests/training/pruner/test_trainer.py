"""Training where to prune: the reference set, the losses, bit-exact resumption, and that it learns."""

import dataclasses
import statistics

import pytest
import torch
from tensordict import TensorDict

from tests.blocks.conftest import ACTION_DIM, COND_DIM, NUM_LAYERS, NUM_STEPS, OBS_STEPS
from torchrl_sparse import keys
from torchrl_sparse.blocks.l2c import StaticGates
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import rate_threshold
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.training.pruner.reference import make_reference, with_queries
from torchrl_sparse.training.pruner.trainer import (
    PrunerConfig,
    PrunerTrainer,
    imitate,
    sparsity_loss,
)

NUM_BLOCKS = 3 * NUM_LAYERS
SMALL = PrunerConfig(rate=0.6, batch_size=4, lr=1e-2, max_updates=6, checkpointed=False)


@pytest.fixture
def policy(network):
    normalizer = Normalizer(
        *(fill(size) for size in (COND_DIM, ACTION_DIM) for fill in (torch.ones, torch.zeros))
    )
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddim", NUM_STEPS))


@pytest.fixture
def demos():
    generator = torch.Generator().manual_seed(0)
    data = {
        keys.STATE: torch.randn(60, COND_DIM, generator=generator),
        keys.ACTION: torch.randn(60, ACTION_DIM, generator=generator).clamp(-1, 1),
    }
    return Demonstrations(TensorDict(data, [60]), torch.tensor([0, 20, 40, 60]))


@pytest.fixture
def reference(policy, demos):
    return make_reference(policy, demos, share=0.5, n_action_steps=4)


def sag_gates(policy, **options):
    torch.manual_seed(3)
    return PrunerNetwork(policy.sampler.timesteps.tolist(), NUM_BLOCKS, (OBS_STEPS, COND_DIM), **options)


def trainer_of(policy, reference, gates=None, **changes):
    config = dataclasses.replace(SMALL, **changes)
    if gates is None:
        gates = sag_gates(policy, rate_input=config.rate_range is not None)
    return PrunerTrainer(gates, policy, reference, config)


def test_the_reference_set_holds_what_the_dense_policy_answers(policy, demos, reference):
    assert len(reference) == round(0.5 * len(demos.window_rows(policy.horizon, OBS_STEPS, 4)))
    noise = policy.sample_noise(reference[keys.SEED].squeeze(-1))
    torch.testing.assert_close(
        reference["target"], policy.denoise(noise, reference[keys.COND]), rtol=0, atol=1e-5
    )
    assert reference[keys.SEED].unique().numel() == len(reference)


def test_the_reference_set_of_data_holds_what_was_demonstrated(policy, demos):
    reference = make_reference(policy, demos, share=1.0, target="data", n_action_steps=4)
    windows = demos.windows(demos.window_rows(policy.horizon, OBS_STEPS, 4), OBS_STEPS)
    assert torch.equal(
        reference["target"].sum((1, 2)).sort().values, windows[keys.ACTION].sum((1, 2)).sort().values
    )


def test_queries_join_a_reference_set_with_the_dense_answers(policy, reference):
    queries = TensorDict(
        {keys.COND: torch.randn(5, OBS_STEPS, COND_DIM), keys.SEED: torch.arange(5)[:, None]}, [5]
    )
    joined = with_queries(policy, reference, queries)
    assert len(joined) == len(reference) + 5
    dense = policy.denoise(policy.sample_noise(torch.arange(5)), queries[keys.COND])
    for expected, row in zip(dense, range(5), strict=True):
        (found,) = (joined[keys.SEED] == row).squeeze(-1).nonzero().flatten()
        assert torch.allclose(joined["target"][found], expected, atol=1e-5)
    kept = torch.isin(joined["target"].sum((1, 2)), reference["target"].sum((1, 2)))
    assert kept.sum() == len(reference)


@pytest.mark.parametrize("share", [0.0, 0.001, 1.5])
def test_an_empty_reference_set_is_refused(policy, demos, share):
    with pytest.raises(ValueError, match=r"share: expected at least one of \d+ windows"):
        make_reference(policy, demos, share=share, n_action_steps=4)


def test_sparsity_counts_blocks_or_what_they_cost():
    gate = torch.zeros(2, 4, 3)
    gate[0, 1:, 2] = 1  # 3 of 12 blocks, all of the third column
    rate = torch.full((2, 1), 0.25)
    assert sparsity_loss(gate, rate, torch.ones(3)).item() == pytest.approx((0 + 0.25) / 2)
    weight = torch.tensor([1.0, 1.0, 8.0])
    assert sparsity_loss(gate, rate, weight).item() == pytest.approx((0.6 - 0.25 + 0.25) / 2)
    by_block = sparsity_loss(gate, rate, weight, per_block=True)
    assert by_block.item() == pytest.approx((0.25 + 0.25 + 0.5 + 3 * 0.25) / 6)


def begun_from_a_mask(policy, reference):
    """SAG's training as the recipe's `init` begins it; from random gates, how far sixty updates get is a matter of rounding."""
    gates = sag_gates(policy)
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.65
    mask[0] = False
    imitate(gates, [mask], reference, updates=400)
    return trainer_of(policy, reference, gates, max_updates=60, epochs=100, lr=1e-3, batch_size=16)


def begun_from_nothing(policy, reference):
    gates = StaticGates(NUM_STEPS, NUM_BLOCKS)
    return trainer_of(policy, reference, gates, max_updates=60, epochs=100, lr=3e-2)


@pytest.mark.parametrize("begin", [begun_from_a_mask, begun_from_nothing], ids=["sag", "l2c"])
def test_training_reaches_the_rate_and_beats_random_masks_of_it(policy, reference, begin):
    trainer = begin(policy, reference)
    before = trainer.validate()
    while trainer.step < trainer.total:
        trainer.train_step()
    learned = trainer.validate()
    assert learned["rate"] == pytest.approx(0.6, abs=0.06)
    assert learned["error"] + abs(learned["rate"] - 0.6) < before["error"] + abs(before["rate"] - 0.6)
    held_out = trainer.held_out
    noise = policy.sample_noise(held_out[keys.SEED].squeeze(-1))
    errors = []
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        masks = torch.rand(len(held_out), NUM_STEPS, NUM_BLOCKS, generator=generator) < learned["rate"]
        masks[:, 0] = False
        actions = policy.denoise(noise, held_out[keys.COND], masks, reuse="type")
        errors.append((actions - held_out["target"]).abs().mean().item())
    assert learned["error"] < statistics.median(errors)


@pytest.mark.parametrize("rate_input", [False, True])
def test_gates_learn_a_mask_to_begin_from(policy, reference, rate_input):
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.5
    mask[0] = False
    gates = sag_gates(policy, rate_input=rate_input)
    imitate(gates, [mask], reference, updates=1200)
    cond = reference[keys.COND][:5]
    rate = torch.full((5, 1), prune_rate(mask).item()) if rate_input else None
    logits = gates.prune_logits(cond, rate)[:, 1:]
    assert ((logits > 0) == mask[1:]).float().mean() > 0.98
    assert logits.abs().max() < 4  # or gradients would not reach them
    with pytest.raises(ValueError, match=r"mask: expected \[K, 3L\] = \[\d+, \d+\] as the gates have, got"):
        imitate(gates, [mask[1:]], reference)


def test_gates_learn_a_mask_for_each_of_several_rates(policy, reference):
    generator = torch.Generator().manual_seed(1)
    masks = [torch.rand(NUM_STEPS, NUM_BLOCKS, generator=generator) < rate for rate in (0.3, 0.7)]
    for mask in masks:
        mask[0] = False
    gates = sag_gates(policy, rate_input=True)
    imitate(gates, masks, reference, updates=600)
    cond = reference[keys.COND][:5]
    for mask in masks:
        rate = torch.full((5, 1), prune_rate(mask).item())
        logits = gates.prune_logits(cond, rate)
        pruned = logits[:, 1:] > rate_threshold(logits, rate)
        assert (pruned == mask[1:]).float().mean() > 0.9
    with pytest.raises(ValueError, match="masks: expected one for gates that do not read the rate, got 2"):
        imitate(sag_gates(policy), masks, reference)
    with pytest.raises(ValueError, match="masks: expected at least one, got 0"):
        imitate(gates, [], reference)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"estimator": "gumbel", "explore": 0.5},
        {"gradient": "step", "norm": "l2"},
        {"sparsity": "block", "checkpointed": True},
        {"cost": "flops"},
        {"rate_range": (0.5, 0.7)},
        {"cost": "seconds"},
    ],
)
def test_a_resumed_training_is_equal_to_the_last_bit(policy, reference, tmp_path, options):
    whole = trainer_of(policy, reference, **options)
    for _ in range(2):
        whole.train_step()
    whole.save(tmp_path / "checkpoint.pt")
    expected = [whole.train_step() for _ in range(2)]
    second = trainer_of(policy, reference, **options)
    second.load(tmp_path / "checkpoint.pt")
    second.validate()  # must not disturb
    assert [second.train_step() for _ in range(2)] == expected
    for name, value in whole.gates.state_dict().items():
        assert torch.equal(value, second.gates.state_dict()[name])


def test_the_policy_is_not_trained(policy, reference):
    before = policy.fingerprint
    trainer_of(policy, reference).train_step()
    assert policy.fingerprint == before
    assert all(parameter.grad is None for parameter in policy.network.parameters())


def test_a_checkpoint_of_another_training_is_refused(policy, reference, tmp_path):
    trainer_of(policy, reference).save(tmp_path / "checkpoint.pt")
    with pytest.raises(
        ValueError, match=r"checkpoint.pt: made with another config: rate is 0.8 here and 0.6"
    ):
        trainer_of(policy, reference, rate=0.8).load(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="made with another reference"):
        trainer_of(policy, reference[:-3]).load(tmp_path / "checkpoint.pt")
    data = (tmp_path / "checkpoint.pt").read_bytes()
    (tmp_path / "half.pt").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"half.pt: expected a training checkpoint"):
        trainer_of(policy, reference).load(tmp_path / "half.pt")


def test_costs_weigh_blocks_by_their_type(policy, reference):
    weight = trainer_of(policy, reference, cost="flops").weight
    costs = policy.block_costs()
    assert weight.tolist() == [costs[kind].flops for kind in ("SA", "CA", "FFN")] * NUM_LAYERS
    assert (trainer_of(policy, reference, cost="seconds").weight > 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 1.0}, r"rate: expected a prune rate in \(0, 1\), got 1.0"),
        ({"rate_range": (0.7, 0.9)}, "rate_range: expected 0 < low <= rate=0.6"),
        (
            {"rate_range": (0.5, 0.9), "cost": "flops"},
            "cost: expected 'blocks' with a rate_range, got 'flops'",
        ),
        ({"estimator": "reinforce"}, "estimator: expected one of .*got 'reinforce'"),
        ({"cost": "joules"}, "cost: expected one of .*got 'joules'"),
        ({"reuse": "layer"}, "reuse: expected one of .*got 'layer'"),
        ({"lr": 0.0}, "lr: expected a positive number, got 0.0"),
    ],
)
def test_a_wrong_configuration_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **options)


def test_gates_and_configuration_have_to_agree(policy, reference):
    with pytest.raises(ValueError, match="rate_range: expected one if and only if the gates read the rate"):
        trainer_of(policy, reference, sag_gates(policy), rate_range=(0.5, 0.7))
    with pytest.raises(ValueError, match="expected at least 2 observations, got 1"):
        trainer_of(policy, reference[:1])
    with pytest.raises(
        ValueError, match=f"rate: expected at most {1 - 1 / NUM_STEPS:g}, since the first step"
    ):
        trainer_of(policy, reference, rate=0.99)


def test_the_fixed_mask_of_static_gates_is_their_own(policy, reference):
    gates = StaticGates(NUM_STEPS, NUM_BLOCKS)
    torch.nn.init.normal_(gates.logits)
    expected = gates.logits.detach() > 0
    expected[0] = False
    assert torch.equal(trainer_of(policy, reference, gates).fixed_mask(), expected)


def test_no_static_mask_of_its_rate_is_nearer_to_the_pruned_ones(policy, reference):
    gates = sag_gates(policy)
    torch.nn.init.normal_(gates.fuse_obs.weight)  # so that masks differ
    trainer = trainer_of(policy, reference, gates)
    fixed = trainer.fixed_mask()
    masks = gates.prune_logits(trainer.train_set[keys.COND]) > 0
    masks[:, 0] = False
    assert masks.float().var(dim=0).mean() > 0
    assert fixed.sum().item() == round(masks.sum().item() / len(masks))
    differing = (masks != fixed).sum()
    for seed in range(20):
        other = fixed.flatten()[torch.randperm(fixed.numel(), generator=torch.Generator().manual_seed(seed))]
        assert (masks != other.view_as(fixed)).sum() >= differing
