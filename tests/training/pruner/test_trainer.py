"""Training where to prune: the losses, bit-exact resumption, and that it learns."""

import dataclasses
import statistics

import pytest
import torch

from tests.blocks.conftest import NUM_LAYERS, NUM_STEPS
from tests.refusals import refused
from tests.training.pruner.conftest import NUM_BLOCKS, sag_gates
from torchrl_sparse import keys
from torchrl_sparse.blocks.l2c import StaticGates, noise_errors
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.fit import fit_to_masks, spread_logits
from torchrl_sparse.training.pruner.loss import mutual_information, sparsity_loss
from torchrl_sparse.training.pruner.trainer import PrunerTrainer

SMALL = PrunerConfig(reuse="type", rate=0.6, batch_size=4, lr=1e-2, max_updates=6, checkpointed=False)


def trainer_of(policy, targets, gates=None, **changes):
    config = dataclasses.replace(SMALL, **changes)
    if gates is None:
        gates = sag_gates(policy, rate_input=config.rate_range is not None)
    return PrunerTrainer(gates, policy, targets, config)


def test_sparsity_counts_blocks_or_what_they_cost():
    gate = torch.zeros(2, 4, 3)
    gate[0, 1:, 2] = 1  # 3 of 12 blocks, all of the third column
    rate = torch.full((2, 1), 0.25)
    assert sparsity_loss(gate, rate, torch.ones(3)).item() == pytest.approx((0 + 0.25) / 2)
    weight = torch.tensor([1.0, 1.0, 8.0])
    assert sparsity_loss(gate, rate, weight).item() == pytest.approx((0.6 - 0.25 + 0.25) / 2)
    by_block = sparsity_loss(gate, rate, weight, per_block=True)
    assert by_block.item() == pytest.approx((0.25 + 0.25 + 0.5 + 3 * 0.25) / 6)


def test_information_is_what_masks_tell_of_their_observations():
    alike = torch.tensor([[5.0, -5.0, 0.0]]).expand(4, 2, 3)
    assert mutual_information(alike).item() == pytest.approx(0, abs=1e-6)
    opposed = torch.full((4, 2, 3), 50.0)
    opposed[:2] = -50.0
    assert mutual_information(opposed).item() == pytest.approx(1, abs=1e-3)
    logits = opposed.clone().requires_grad_()
    mutual_information(logits).backward()
    assert logits.grad.isfinite().all()


def test_a_reward_for_variety_makes_masks_follow_the_observation(policy, targets):
    information = []
    for variety in (0.0, 1.0):
        gates = sag_gates(policy)
        spread_logits(gates, targets, 0.5)
        trainer = trainer_of(policy, targets, gates, variety=variety, max_updates=25, epochs=100, lr=1e-3)
        information.append([trainer.train_step()["information"] for _ in range(trainer.total)][-1])
    assert information[1] > 1.2 * information[0] > 0


def test_information_that_is_asked_for_is_kept_where_a_reward_of_itself_lets_go(policy, targets):
    """Both begin alike, and a high weight of the rate drives their masks together."""
    kept = {}
    for asked in (None, 0.05):
        gates = sag_gates(policy)
        spread_logits(gates, targets, 0.5)
        options = {"variety": 0.1, "information": asked, "rate": 0.8, "beta": 5.0}
        trainer = trainer_of(policy, targets, gates, max_updates=60, epochs=100, lr=3e-3, **options)
        told = [trainer.train_step()["information"] for _ in range(trainer.total)]
        kept[asked] = sum(told[40:]) / 20
    assert 4 * kept[None] < 0.02 < kept[0.05]


def begun_from_a_mask(policy, targets):
    """SAG's training as the recipe's `init` begins it; how far so few updates get from random gates is a matter of rounding."""
    gates = sag_gates(policy)
    mask = torch.rand(NUM_STEPS, NUM_BLOCKS, generator=torch.Generator().manual_seed(1)) < 0.65
    mask[0] = False
    fit_to_masks(gates, [mask], targets, updates=400)
    return trainer_of(policy, targets, gates, max_updates=120, epochs=100, lr=3e-3, batch_size=16)


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


def test_the_objective_of_learning_to_cache_learns_where_a_step_after_a_dense_one_errs_least(policy, targets):
    gates = StaticGates(NUM_STEPS, NUM_BLOCKS)
    options = {"objective": "noise", "reuse": "block", "norm": "l2", "rate": 0.25}
    trainer = trainer_of(policy, targets, gates, max_updates=300, epochs=200, lr=0.1, **options)
    while trainer.step < trainer.total:
        trainer.train_step()
    learned = trainer.fixed_mask()
    assert not learned[::2].any()
    assert learned.float().mean() == pytest.approx(0.25, abs=0.06)

    def error(mask):
        torch.manual_seed(0)
        clean, cond = trainer.held_out["target"], trainer.held_out[keys.COND]
        noise = torch.randn(len(clean), 2, *clean.shape[1:])
        gates = mask.float().expand(len(clean), -1, -1)
        query = policy.network, policy.sampler, clean, noise, cond
        steps = range(1, NUM_STEPS, 2)
        return sum(noise_errors(*query, gates[:, step], step).square().mean() for step in steps).item()

    errors = []
    for seed in range(10):
        cells = torch.randperm(NUM_BLOCKS * NUM_STEPS // 2, generator=torch.Generator().manual_seed(seed))
        mask = torch.zeros(NUM_STEPS, NUM_BLOCKS, dtype=torch.bool)
        mask[1::2] = (cells < learned.sum()).view(-1, NUM_BLOCKS)
        errors.append(error(mask))
    assert error(learned) < min(errors)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"objective": "noise", "reuse": "block", "rate": 0.4},
        {"estimator": "gumbel", "explore": 0.5},
        {"gradient": "step", "norm": "l2"},
        {"sparsity": "block", "checkpointed": True},
        {"cost": "flops"},
        {"rate_range": (0.5, 0.7)},
        {"cost": "seconds"},
        {"estimator": "gumbel", "final_temperature": 0.2, "variety": 0.1, "detached": True},
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
    with refused("checkpoint.pt"):
        trainer_of(policy, targets, rate=0.8).load(tmp_path / "checkpoint.pt")
    with refused("checkpoint.pt"):
        trainer_of(policy, targets[:-3]).load(tmp_path / "checkpoint.pt")
    data = (tmp_path / "checkpoint.pt").read_bytes()
    (tmp_path / "half.pt").write_bytes(data[: len(data) // 2])
    with refused("half.pt"):
        trainer_of(policy, targets).load(tmp_path / "half.pt")


def test_costs_weigh_blocks_by_their_type(policy, targets):
    weight = trainer_of(policy, targets, cost="flops").weight
    costs = policy.block_costs()
    assert weight.tolist() == [costs[kind].flops for kind in ("SA", "CA", "FFN")] * NUM_LAYERS
    assert (trainer_of(policy, targets, cost="seconds").weight > 0).all()


@pytest.mark.parametrize(
    ("options", "entry"),
    [
        ({"objective": "steps"}, "objective"),
        ({"objective": "noise"}, "reuse"),
        ({"rate": 1.0}, "rate"),
        ({"rate_range": (0.7, 0.9)}, "rate_range"),
        (
            {"rate_range": (0.5, 0.9), "cost": "flops"},
            "cost",
        ),
        ({"estimator": "reinforce"}, "estimator"),
        ({"cost": "joules"}, "cost"),
        ({"reuse": "layer"}, "reuse"),
        ({"lr": 0.0}, "lr"),
        ({"final_temperature": 0.0}, "final_temperature"),
        ({"variety": -1.0}, "variety"),
        ({"variety": 0.1, "information": 1.5}, "information"),
        ({"information": 0.1}, "information"),
    ],
)
def test_a_wrong_configuration_is_refused(options, entry):
    with refused(entry):
        dataclasses.replace(SMALL, **options)


def test_gates_and_configuration_have_to_agree(policy, targets):
    with refused("rate_range"):
        trainer_of(policy, targets, sag_gates(policy), rate_range=(0.5, 0.7))
    with refused("targets"):
        trainer_of(policy, targets[:1])
    with refused("rate"):
        trainer_of(policy, targets, rate=0.99)
    with refused("rate"):
        trainer_of(policy, targets, objective="noise", reuse="block", rate=0.6)


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
