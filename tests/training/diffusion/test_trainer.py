"""Training: bit-exact resume, sampling order, averaged weights, and checkpoints that are refused."""

import dataclasses
import os
import pickle

import pytest
import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from diffusers.training_utils import EMAModel

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, keys
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer
from torchrl_sparse.training.trainer import batch_indices

CONFIG = TrainConfig(max_steps=12, batch_size=8, n_action_steps=4, lr=1e-3, lr_warmup_steps=3, val_ratio=0.2)


@pytest.fixture
def make_trainer(make_network, demos):
    def make(network_changes=None, **changes) -> PolicyTrainer:
        normalizer = Normalizer.fit(demos.data[keys.STATE], demos.data[keys.ACTION])
        network = make_network(**({"p_drop_attn": 0.2} | (network_changes or {})))
        policy = DiffusionPolicy(network, normalizer, engine="reference")
        return PolicyTrainer(policy, demos, dataclasses.replace(CONFIG, **changes))

    return make


def run(trainer, until):
    return [trainer.train_step()["loss"] for _ in range(until - trainer.step)]


def weights(trainer):
    return [*trainer.network.state_dict().values(), *trainer.ema_policy().network.state_dict().values()]


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_resumed_training_equals_an_unbroken_one_to_the_last_bit(make_trainer, tmp_path, precision):
    unbroken = make_trainer(precision=precision)
    losses = run(unbroken, 12)
    first = make_trainer(precision=precision)
    begun = run(first, 5)
    first.save(tmp_path / "checkpoint.pt")
    run(first, 7)
    second = make_trainer(precision=precision)
    run(second, 2)
    torch.manual_seed(123)
    second.load(tmp_path / "checkpoint.pt")
    assert second.step == 5
    assert begun + run(second, 12) == losses
    assert all(torch.equal(a, b) for a, b in zip(weights(second), weights(unbroken), strict=True))
    assert second.lr == unbroken.lr


def test_on_a_cpu_no_fused_attention_slows_a_step_down(make_trainer):
    trainer = make_trainer({"p_drop_attn": 0.0})
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        trainer.train_step()
    called = {event.key for event in profile.key_averages()}
    assert "aten::_scaled_dot_product_attention_math" in called
    assert not any("flash" in name for name in called)


def test_validating_and_saving_change_nothing(make_trainer, tmp_path):
    plain, watched = make_trainer(), make_trainer()
    losses = run(plain, 4)
    seen = []
    for _ in range(4):
        seen.append(watched.train_step()["loss"])
        assert watched.validate() == watched.validate()
        watched.save(tmp_path / "checkpoint.pt")
    assert seen == losses


def test_loss_falls(make_trainer):
    losses = run(make_trainer(max_steps=150, lr=3e-3, batch_size=32), 150)
    assert sum(losses[-20:]) < 0.8 * sum(losses[:20])


def test_learning_rate_warms_up_and_ends_at_zero(make_trainer):
    trainer = make_trainer()
    rates = [trainer.lr]
    for _ in range(12):
        trainer.train_step()
        rates.append(trainer.lr)
    assert rates[:4] == pytest.approx([0, 1e-3 / 3, 2e-3 / 3, 1e-3])
    assert rates[3:] == sorted(rates[3:], reverse=True)
    assert rates[-1] == pytest.approx(0, abs=1e-9)


def test_learning_rate_stays_at_zero_beyond_the_last_step(make_trainer):
    """diffusers' cosine rises again (findings/diffusers_cosine_rises_again.sh); until there it is the same, to the bit."""
    trainer = make_trainer(max_steps=8, lr_warmup_steps=2)
    weights = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weights], lr=1e-3)
    reference = get_cosine_schedule_with_warmup(optimizer, 2, 8)
    for _ in range(8):
        assert trainer.lr == reference.get_last_lr()[0]
        trainer.train_step()
        optimizer.step()
        reference.step()
    for _ in range(4):
        assert trainer.lr == 0
        trainer.train_step()


def test_averaged_weights_follow_diffusers(make_trainer):
    trainer = make_trainer()
    average = EMAModel(
        trainer.network.parameters(), decay=0.9999, power=0.75, update_after_step=0, use_ema_warmup=True
    )
    for _ in range(6):
        trainer.train_step()
        average.step(trainer.network.parameters())
    parameters = [*trainer.ema_policy().network.parameters()]
    for ours, theirs in zip(parameters, average.shadow_params, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-7, rtol=1e-6)
    assert any(not torch.equal(a, b) for a, b in zip(parameters, trainer.network.parameters(), strict=True))


def test_held_out_episodes_are_not_trained_on(make_trainer, demos):
    trainer = make_trainer()
    boundary = int(demos.starts[-3])
    assert trainer.train_rows.max() < boundary <= trainer.val_rows.min()
    assert make_trainer(val_ratio=0).validate() == {}


def test_batches_use_every_window_equally_often_across_epochs():
    index = torch.cat([batch_indices(10, 4, step, seed=3) for step in range(5)])
    assert index.bincount(minlength=10).tolist() == [2] * 10
    assert index[:10].sort().values.tolist() == list(range(10))
    assert index[:10].tolist() != index[10:].tolist()
    assert not torch.equal(batch_indices(10, 4, 0, seed=4), index[:4])


def test_a_batch_may_hold_more_than_one_epoch():
    assert batch_indices(3, 9, 0, seed=0).bincount().tolist() == [3, 3, 3]


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"lr": 2e-3}, "checkpoint.pt"),
        ({"network_changes": {"n_layer": 1}}, "checkpoint.pt"),
        ({"val_ratio": 0.3}, "checkpoint.pt"),
    ],
)
def test_checkpoint_of_another_training_is_refused(make_trainer, tmp_path, changes, entry):
    make_trainer().save(tmp_path / "checkpoint.pt")
    with refused(entry):
        make_trainer(**changes).load(tmp_path / "checkpoint.pt")


def test_checkpoint_of_other_demonstrations_is_refused(make_trainer, tmp_path, demos):
    trainer = make_trainer()
    trainer.save(tmp_path / "checkpoint.pt")
    demos.data[keys.ACTION][0, 0] += 1
    with refused("checkpoint.pt"):
        make_trainer().load(tmp_path / "checkpoint.pt")


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_nothing_in_a_checkpoint_is_executed(make_trainer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps(Bomb(), protocol=2))
    torch.save({"step": Bomb()}, tmp_path / "torch.pt")
    for name in ("pickle.pt", "torch.pt"):
        with refused(name):
            make_trainer().load(tmp_path / name)
    assert not (tmp_path / "exploded").exists()


def test_damaged_checkpoints_are_named(make_trainer, tmp_path):
    trainer = make_trainer()
    whole = tmp_path / "whole.pt"
    trainer.save(whole)
    (tmp_path / "half.pt").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    torch.save({"step": 1}, tmp_path / "other.pt")
    for name in ("half.pt", "other.pt"):
        with refused(name):
            trainer.load(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        trainer.load(tmp_path / "missing.pt")


def test_diverged_training_stops_with_the_weights_it_had(make_trainer):
    trainer = make_trainer()
    before = [value.clone() for value in weights(trainer)]
    trainer.policy.normalizer.action_scale.fill_(torch.inf)
    with pytest.raises(FloatingPointError, match="step 0: loss is nan"):
        trainer.train_step()
    assert all(torch.equal(a, b) for a, b in zip(before, weights(trainer), strict=True))


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"max_steps": 0}, "max_steps, batch_size"),
        ({"precision": "fp16"}, "precision"),
        ({"val_ratio": 1.0}, "val_ratio"),
        ({"val_ratio": 0.95}, "val_ratio"),
        ({"n_action_steps": 9}, "horizon"),
    ],
)
def test_bad_configuration_is_named(make_trainer, changes, entry):
    with refused(entry):
        make_trainer(**changes)
