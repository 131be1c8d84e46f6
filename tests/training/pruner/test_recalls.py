"""Training what is recalled: its calibration set, its losses turn by turn, bit-exact resumption, and that it learns."""

import dataclasses

import pytest
import torch

from tests.blocks.conftest import NUM_STEPS
from tests.training.pruner.conftest import NUM_BLOCKS, sag_gates
from torchrl_sparse import keys
from torchrl_sparse.blocks.recall import RecallSchedule
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.training.diffusion.recall_choice import Choice, RecallJudge
from torchrl_sparse.training.diffusion.targets import make_targets
from torchrl_sparse.training.pruner.config import PrunerConfig
from torchrl_sparse.training.pruner.export import export_planner
from torchrl_sparse.training.pruner.fit import spread_logits
from torchrl_sparse.training.pruner.recalls import RecallTrainer, check_turns, pruner_trainer

SMALL = PrunerConfig(rate=0.6, batch_size=8, lr=1e-3, max_updates=100, epochs=100, checkpointed=False)


@pytest.fixture
def turns(policy, demos):
    return make_targets(policy, demos, share=0.8, n_action_steps=4, turns=3)


def trainer_of(policy, turns, **changes):
    gates = sag_gates(policy, recalls=True)
    spread_logits(gates, turns.reshape(-1), 1.0)
    return pruner_trainer(gates, policy, turns, dataclasses.replace(SMALL, **changes))


def test_turns_are_the_queries_that_an_episode_would_ask(policy, demos, turns):
    assert turns.batch_dims == 2
    assert turns.shape[1] == 3
    states = policy.normalizer.normalize_state(demos.data[keys.STATE])
    for query in turns:
        present = [(states == one[-1]).all(dim=1).nonzero().item() for one in query[keys.COND]]
        assert present == [present[0], present[0] + 4, present[0] + 8]
        assert present[0] // 20 == present[2] // 20  # episodes of 20
        for row, one in zip(present, query[keys.COND], strict=True):
            assert torch.equal(one[0], states[max(row - 1, row // 20 * 20)])
    assert turns[keys.SEED].unique().numel() == turns.numel()
    flat = turns.reshape(-1)
    answers = policy.denoise(policy.sample_noise(flat[keys.SEED].squeeze(-1)), flat[keys.COND])
    torch.testing.assert_close(flat["target"], answers, rtol=0, atol=1e-5)
    with pytest.raises(
        ValueError, match="turns: expected an episode with 6 queries 4 actions apart, got none"
    ):
        make_targets(policy, demos, share=1.0, n_action_steps=4, turns=6)


def test_the_error_is_that_of_queries_in_a_row(policy, turns):
    """Gates that choose the same for all observations, against the judge of such choices."""
    trainer = trainer_of(policy, turns)
    assert isinstance(trainer, RecallTrainer)
    with torch.no_grad():
        trainer.gates.obs.weight.zero_()
    trainer.gates.eval()
    mask, recalled = (one[0] for one in trainer._choice(trainer.held_out[:, 0]))
    assert 0 < recalled.sum() < mask.sum()
    judge = RecallJudge(policy, list(trainer.held_out), draws=1, n_action_steps=4, reuse="block", seed=0)
    episodes = sorted(trainer.held_out, key=len)
    judge._turns = [
        (cond, seed.flatten(), target)
        for cond, seed, target in zip(
            *(torch.stack([one[key] for one in episodes], dim=1) for key in (keys.COND, keys.SEED, "target")),
            strict=True,
        )
    ]
    judge._executed = slice(None)
    nothing = torch.zeros_like(mask)
    empty = torch.zeros(len(episodes), NUM_STEPS, NUM_BLOCKS, policy.network.horizon, policy.network.n_emb)
    judge._first = judge._answer(0, Choice(nothing, nothing), empty)[1]
    found = trainer.validate()
    assert found["error"] == pytest.approx(judge.error(Choice(mask, recalled)), rel=1e-4)
    assert found["recalled"] == pytest.approx(recalled.float().mean().item())
    assert found["varying"] == 0
    losses = trainer.batch_losses(torch.arange(3))
    assert losses["recalled"].item() == pytest.approx(found["recalled"])
    assert losses["loss"].item() == pytest.approx((losses["fidelity"] + losses["sparsity"]).item())


def test_training_learns_to_recall_where_queries_repeat(policy, turns):
    """What an equal query computed is what this one would compute: all that is pruned should be recalled."""
    trainer = trainer_of(policy, turns[:, :1].expand(len(turns), 3).clone())
    start = trainer.validate()
    while trainer.step < trainer.total:
        trainer.train_step()
    learned = trainer.validate()
    assert learned["rate"] == pytest.approx(0.6, abs=0.06)
    assert learned["error"] < 0.5 * start["error"]
    assert learned["recalled"] > 1.3 * start["recalled"]


def test_a_training_goes_on_where_it_stopped(policy, turns, tmp_path):
    whole = trainer_of(policy, turns, max_updates=4)
    steps = [whole.train_step() for _ in range(4)]
    half = trainer_of(policy, turns, max_updates=4)
    assert [half.train_step() for _ in range(2)] == steps[:2]
    half.save(tmp_path / "checkpoint.pt")
    resumed = trainer_of(policy, turns, max_updates=4)
    resumed.load(tmp_path / "checkpoint.pt")
    assert [resumed.train_step() for _ in range(2)] == steps[2:]
    for name, weight in whole.gates.state_dict().items():
        assert torch.equal(weight, resumed.gates.state_dict()[name])


def test_the_planner_and_its_mean_are_written(policy, turns, tmp_path):
    trainer = trainer_of(policy, turns, reuse="type")
    folder = export_planner(trainer, tmp_path, {"init": []})
    planner = load_planner(folder, policy.plan.spec)
    assert (planner.reuse, planner.info.settings["updates"]) == ("type", 0)
    fixed = load_planner(tmp_path / "fixed.json", policy.plan.spec)
    assert isinstance(fixed, RecallSchedule)
    assert torch.equal(fixed.mask, trainer.fixed_mask())
    choices = [trainer._choice(query) for query in trainer.train_set.unbind(1)]
    pruned, recalled = (torch.cat(cells).float().mean(dim=0) for cells in zip(*choices, strict=True))
    often = recalled >= 0.5 * pruned
    assert torch.equal(fixed.chosen, fixed.mask & often & (recalled > 0))
    assert fixed.chosen.any()


def test_what_does_not_fit_is_refused(policy, turns, targets):
    with pytest.raises(
        ValueError, match=r"turns: expected 2 or more for such gates, got targets of shape \[\d+\]"
    ):
        pruner_trainer(sag_gates(policy, recalls=True), policy, targets, SMALL)
    with pytest.raises(
        ValueError, match=r"turns: expected 1 for such gates, got targets of shape \[\d+, 3\]"
    ):
        pruner_trainer(sag_gates(policy), policy, turns, SMALL)
    for recalls, count in ((True, 1), (False, 3)):  # what the recipe asks before it makes any
        with pytest.raises(ValueError, match=rf"targets\.turns: expected .* for such gates, got {count}"):
            check_turns(sag_gates(policy, recalls=recalls), count)
        check_turns(sag_gates(policy, recalls=not recalls), count)
    for name, value in (("gradient", "step"), ("objective", "noise"), ("rate_range", (0.3, 0.7))):
        config = dataclasses.replace(SMALL, **{name: value})
        with pytest.raises(ValueError, match=rf"{name}: expected .* for gates that recall, got"):
            pruner_trainer(sag_gates(policy, recalls=True), policy, turns, config)
