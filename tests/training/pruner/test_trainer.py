"""Training where to prune: the targets, the losses, bit-exact resumption, and that it learns."""

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
from torchrl_sparse.training.diffusion.targets import add_queries, load_targets, make_targets, save_targets
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.fit import fit_to_masks
from torchrl_sparse.training.pruner.loss import sparsity_loss
from torchrl_sparse.training.pruner.trainer import PrunerTrainer

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
def targets(policy, demos):
    return make_targets(policy, demos, share=0.5, n_action_steps=4)


def sag_gates(policy, **options):
    torch.manual_seed(3)
    return PrunerNetwork(policy.sampler.timesteps.tolist(), NUM_BLOCKS, (OBS_STEPS, COND_DIM), **options)


def trainer_of(policy, targets, gates=None, **changes):
    config = dataclasses.replace(SMALL, **changes)
    if gates is None:
        gates = sag_gates(policy, rate_input=config.rate_range is not None)
    return PrunerTrainer(gates, policy, targets, config)


def test_targets_are_what_the_dense_policy_answers(policy, demos, targets):
    assert len(targets) == round(0.5 * len(demos.window_rows(policy.horizon, OBS_STEPS, 4)))
    noise = policy.sample_noise(targets[keys.SEED].squeeze(-1))
    torch.testing.assert_close(
        targets["target"], policy.denoise(noise, targets[keys.COND]), rtol=0, atol=1e-5
    )
    assert targets[keys.SEED].unique().numel() == len(targets)


def test_targets_from_data_are_what_was_demonstrated(policy, demos):
    targets = make_targets(policy, demos, share=1.0, source="data", n_action_steps=4)
    windows = demos.windows(demos.window_rows(policy.horizon, OBS_STEPS, 4), OBS_STEPS)
    assert torch.equal(
        targets["target"].sum((1, 2)).sort().values, windows[keys.ACTION].sum((1, 2)).sort().values
    )


def test_queries_join_targets_with_the_dense_answers(policy, targets):
    queries = TensorDict(
        {keys.COND: torch.randn(5, OBS_STEPS, COND_DIM), keys.SEED: torch.arange(5)[:, None]}, [5]
    )
    joined = add_queries(policy, targets, queries)
    assert len(joined) == len(targets) + 5
    dense = policy.denoise(policy.sample_noise(torch.arange(5)), queries[keys.COND])
    for expected, row in zip(dense, range(5), strict=True):
        (found,) = (joined[keys.SEED] == row).squeeze(-1).nonzero().flatten()
        assert torch.allclose(joined["target"][found], expected, atol=1e-5)
    kept = torch.isin(joined["target"].sum((1, 2)), targets["target"].sum((1, 2)))
    assert kept.sum() == len(targets)


def test_targets_are_kept_in_a_file_for_what_they_were_made_for(targets, tmp_path):
    path, made_for = tmp_path / "targets.safetensors", {"policy": "one", "share": 0.5}
    save_targets(path, targets, made_for)
    loaded = load_targets(path, made_for)
    assert set(loaded.keys(True, True)) == set(targets.keys(True, True))
    assert (loaded == targets).all()
    with pytest.raises(
        ValueError, match=r"targets.safetensors: expected targets for .*'two'.*, got some for .*'one'"
    ):
        load_targets(path, {**made_for, "policy": "two"})
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match=r"targets.safetensors: expected a complete safetensors file"):
        load_targets(path, made_for)


@pytest.mark.parametrize("share", [0.0, 0.001, 1.5])
def test_an_empty_calibration_set_is_refused(policy, demos, share):
    with pytest.raises(ValueError, match=r"share: expected at least one of \d+ windows"):
        make_targets(policy, demos, share=share, n_action_steps=4)


def test_sparsity_counts_blocks_or_what_they_cost():
    gate = torch.zeros(2, 4, 3)
    gate[0, 1:, 2] = 1  # 3 of 12 blocks, all of the third column
    rate = torch.full((2, 1), 0.25)
    assert sparsity_loss(gate, rate, torch.ones(3)).item() == pytest.approx((0 + 0.25) / 2)
    weight = torch.tensor([1.0, 1.0, 8.0])
    assert sparsity_loss(gate, rate, weight).item() == pytest.approx((0.6 - 0.25 + 0.25) / 2)
    by_block = sparsity_loss(gate, rate, weight, per_block=True)
    assert by_block.item() == pytest.approx((0.25 + 0.25 + 0.5 + 3 * 0.25) / 6)


def begun_from_a_mask(policy, targets):
    """SAG's training as the recipe's `init` begins it; from random gates, how far sixty updates get is a matter of rounding."""
    gates = sag_gates(policy)
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.65
    mask[0] = False
    fit_to_masks(gates, [mask], targets, updates=400)
    return trainer_of(policy, targets, gates, max_updates=60, epochs=100, lr=1e-3, batch_size=16)


def begun_from_nothing(policy, targets):
    gates = StaticGates(NUM_STEPS, NUM_BLOCKS)
    return trainer_of(policy, targets, gates, max_updates=60, epochs=100, lr=3e-2)


@pytest.mark.parametrize("begin", [begun_from_a_mask, begun_from_nothing], ids=["sag", "l2c"])
def test_training_reaches_the_rate_and_beats_random_masks_of_it(policy, targets, begin):
    trainer = begin(policy, targets)
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
def test_gates_learn_a_mask_to_begin_from(policy, targets, rate_input):
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.5
    mask[0] = False
    gates = sag_gates(policy, rate_input=rate_input)
    fit_to_masks(gates, [mask], targets, updates=1200)
    cond = targets[keys.COND][:5]
    rate = torch.full((5, 1), prune_rate(mask).item()) if rate_input else None
    logits = gates.prune_logits(cond, rate)[:, 1:]
    assert ((logits > 0) == mask[1:]).float().mean() > 0.98
    assert logits.abs().max() < 4  # or gradients would not reach them
    with pytest.raises(ValueError, match=r"mask: expected \[K, 3L\] = \[\d+, \d+\] as the gates have, got"):
        fit_to_masks(gates, [mask[1:]], targets)


def test_gates_learn_a_mask_for_each_of_several_rates(policy, targets):
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
    with pytest.raises(ValueError, match="masks: expected one for gates that do not read the rate, got 2"):
        fit_to_masks(sag_gates(policy), masks, targets)
    with pytest.raises(ValueError, match="masks: expected at least one, got 0"):
        fit_to_masks(gates, [], targets)


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
def test_a_resumed_training_is_equal_to_the_last_bit(policy, targets, tmp_path, options):
    whole = trainer_of(policy, targets, **options)
    for _ in range(2):
        whole.train_step()
    whole.save(tmp_path / "checkpoint.pt")
    expected = [whole.train_step() for _ in range(2)]
    second = trainer_of(policy, targets, **options)
    second.load(tmp_path / "checkpoint.pt")
    second.validate()  # must not disturb
    assert [second.train_step() for _ in range(2)] == expected
    for name, value in whole.gates.state_dict().items():
        assert torch.equal(value, second.gates.state_dict()[name])


def test_the_policy_is_not_trained(policy, targets):
    before = policy.fingerprint
    trainer_of(policy, targets).train_step()
    assert policy.fingerprint == before
    assert all(parameter.grad is None for parameter in policy.network.parameters())


def test_a_checkpoint_of_another_training_is_refused(policy, targets, tmp_path):
    trainer_of(policy, targets).save(tmp_path / "checkpoint.pt")
    with pytest.raises(
        ValueError, match=r"checkpoint.pt: made with another config: rate is 0.8 here and 0.6"
    ):
        trainer_of(policy, targets, rate=0.8).load(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="made with another targets"):
        trainer_of(policy, targets[:-3]).load(tmp_path / "checkpoint.pt")
    data = (tmp_path / "checkpoint.pt").read_bytes()
    (tmp_path / "half.pt").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"half.pt: expected a training checkpoint"):
        trainer_of(policy, targets).load(tmp_path / "half.pt")


def test_costs_weigh_blocks_by_their_type(policy, targets):
    weight = trainer_of(policy, targets, cost="flops").weight
    costs = policy.block_costs()
    assert weight.tolist() == [costs[kind].flops for kind in ("SA", "CA", "FFN")] * NUM_LAYERS
    assert (trainer_of(policy, targets, cost="seconds").weight > 0).all()


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


def test_gates_and_configuration_have_to_agree(policy, targets):
    with pytest.raises(ValueError, match="rate_range: expected one if and only if the gates read the rate"):
        trainer_of(policy, targets, sag_gates(policy), rate_range=(0.5, 0.7))
    with pytest.raises(ValueError, match="expected at least 2 observations, got 1"):
        trainer_of(policy, targets[:1])
    with pytest.raises(
        ValueError, match=f"rate: expected at most {1 - 1 / NUM_STEPS:g}, since the first step"
    ):
        trainer_of(policy, targets, rate=0.99)


def test_the_fixed_mask_of_static_gates_is_their_own(policy, targets):
    gates = StaticGates(NUM_STEPS, NUM_BLOCKS)
    torch.nn.init.normal_(gates.logits)
    expected = gates.logits.detach() > 0
    expected[0] = False
    assert torch.equal(trainer_of(policy, targets, gates).fixed_mask(), expected)


def test_no_static_mask_of_its_rate_is_nearer_to_the_pruned_ones(policy, targets):
    gates = sag_gates(policy)
    torch.nn.init.normal_(gates.fuse_obs.weight)  # so that masks differ
    trainer = trainer_of(policy, targets, gates)
    fixed = trainer.fixed_mask()
    masks = gates.prune_logits(trainer.train_set[keys.COND]) > 0
    masks[:, 0] = False
    assert masks.float().var(dim=0).mean() > 0
    assert fixed.sum().item() == round(masks.sum().item() / len(masks))
    differing = (masks != fixed).sum()
    for seed in range(20):
        other = fixed.flatten()[torch.randperm(fixed.numel(), generator=torch.Generator().manual_seed(seed))]
        assert (masks != other.view_as(fixed)).sum() >= differing
