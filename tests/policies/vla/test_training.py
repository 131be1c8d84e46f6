"""The loss, what windows hold, resuming to the last bit, and that the instruction can be learned."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.trainer import TrainConfig
from torchrl_sparse.policies.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.policies.vla.loss import VLALoss
from torchrl_sparse.policies.vla.network import VLANetwork
from torchrl_sparse.policies.vla.normalize import QuantileNormalizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.policies.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.training import InstructedDemonstrations, VLATrainer

INSTRUCTIONS = ["lift the cube", "lower the cube"] * 3


@pytest.fixture
def demos():
    """Six episodes of the same frames, in which only the instruction says whether the arm goes up or down."""
    torch.manual_seed(0)
    steps = torch.tensor([5, 5, 4, 4, 6, 6])
    frames = torch.randint(256, (6, 3, 28, 28), dtype=torch.uint8)
    image = torch.cat([frames[:count] for count in steps])
    action = torch.zeros(30, 7)
    action[:, 2] = torch.tensor([1.0, -1.0] * 3).repeat_interleave(steps)
    data = {
        keys.IMAGE: image,
        keys.WRIST_IMAGE: image.flip(-1),
        keys.STATE: torch.zeros(30, 8),
        keys.ACTION: action,
    }
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), steps.cumsum(0)])
    return InstructedDemonstrations(Demonstrations(TensorDict(data, [30]), starts), INSTRUCTIONS)


@pytest.fixture
def make_trainer(demos):
    config = VLAConfig.tiny(llm=TransformerSize(32, 2, 2, 64))

    def make(demos=demos, **changes):
        torch.manual_seed(0)
        tokenizer = WordTokenizer(["lift", "lower", "cube"])
        policy = VLAPolicy(VLANetwork(config), QuantileNormalizer.identity(8, 7), tokenizer)
        options = {"max_steps": 6, "batch_size": 4, "lr": 1e-3, "lr_warmup_steps": 2, "val_ratio": 0.3}
        return VLATrainer(policy, demos, TrainConfig(**{**options, **changes}))

    return make


def run(trainer, until):
    return [trainer.train_step() for _ in range(until - trainer.step)]


def test_loss_is_l1_of_what_the_policy_answers(policy, query):
    td = query(3)
    chunk = torch.rand(3, 2, 7)
    chunk[..., 6] = chunk[..., 6].round() * 2 - 1
    is_pad = torch.tensor([[False, True], [False, False], [False, True]])
    td[keys.CHUNK], td[keys.IS_PAD] = chunk, is_pad
    with torch.no_grad():
        loss = VLALoss(policy)(td)["loss"]
        actions, _ = policy.predict(query(3))
    low, high = -2.0, 1.0
    target = torch.cat([2 * (chunk[..., :6] - low) / (high - low) - 1, (1 - chunk[..., 6:]) / 2], -1)
    expected = (actions - target).abs().mean(-1)[~is_pad].mean()
    torch.testing.assert_close(loss, expected)


def test_the_grounding_is_told_by_what_the_actions_are_read_from(policy, query):
    loss = VLALoss(policy, grounding_dim=3, grounding_weight=0.5)
    torch.nn.init.zeros_(loss.grounding.weight)
    torch.nn.init.constant_(loss.grounding.bias, 2.0)
    td = query(3).set(keys.CHUNK, torch.zeros(3, 2, 7))
    with pytest.raises(KeyError, match="grounding"):
        loss(td)
    td[keys.GROUNDING] = torch.zeros(3, 3)
    with torch.no_grad():
        added = loss(td)["loss"] - VLALoss(policy)(td)["loss"]
    torch.testing.assert_close(added, torch.tensor(0.5 * 2.0))


def test_a_chunk_of_another_length_is_named(policy, query):
    td = query(3).set(keys.CHUNK, torch.zeros(3, 4, 7))
    with pytest.raises(ValueError, match=r"chunk.*expected \[B, 2, 7\], got \[3, 4, 7\]"):
        VLALoss(policy)(td)


def test_windows_stay_in_their_episode_and_carry_its_instruction(demos):
    rows = demos.episodes.window_rows(2, 1, 2)
    sample = demos.windows(rows, [keys.IMAGE, keys.STATE])
    assert len(rows) == 30
    assert sample[keys.IS_PAD].nonzero().tolist() == [[row, 1] for row in (4, 9, 13, 17, 23, 29)]
    up = torch.tensor(["lift" in text for text in sample[keys.INSTRUCTION]])
    assert torch.equal(sample[keys.CHUNK][..., 2] > 0, up[:, None].expand(-1, 2))


def test_one_instruction_for_each_episode(demos):
    with pytest.raises(ValueError, match="expected one for each of 6 episodes, got 2"):
        InstructedDemonstrations(demos.episodes, ["lift", "lower"])


def test_resumed_training_equals_an_unbroken_one_to_the_last_bit(make_trainer, tmp_path):
    unbroken, first, second = make_trainer(), make_trainer(), make_trainer()
    losses = run(unbroken, 6)
    begun = run(first, 3)
    first.save(tmp_path / "checkpoint.pt")
    second.load(tmp_path / "checkpoint.pt")
    assert begun + run(second, 6) == losses
    for ours, theirs in ((second.trained, unbroken.trained), (second.averaged(), unbroken.averaged())):
        assert all(torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True))


def test_the_grounding_is_trained_and_left_out_of_the_policy(make_trainer, demos, tmp_path):
    position = torch.tensor([[1.0, 0.0], [-1.0, 0.5]] * 3)
    rows = position.repeat_interleave(demos.episodes.starts.diff(), 0)
    trainer = make_trainer(replace(demos, grounding=rows), max_steps=80, val_ratio=0.0, lr=3e-3)
    losses = run(trainer, 80)
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    assert all("grounding" not in name for name, _ in trainer.averaged().named_parameters())
    trainer.save(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"checkpoint.pt: made with another"):
        make_trainer(max_steps=80, val_ratio=0.0, lr=3e-3).load(tmp_path / "checkpoint.pt")


def test_a_checkpoint_of_another_training_is_refused(make_trainer, tmp_path):
    trainer = make_trainer()
    trainer.save(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match=r"checkpoint.pt: made with another config: lr is"):
        make_trainer(lr=2e-3).load(tmp_path / "checkpoint.pt")


def test_the_instruction_can_be_learned(make_trainer, demos):
    """The frames are the same for both, so no other input tells up from down."""
    options = {"batch_size": 8, "lr": 3e-3, "lr_warmup_steps": 10, "val_ratio": 0.0, "max_grad_norm": 1.0}
    trainer, losses = make_trainer(max_steps=300, **options), [1.0] * 5
    # whoever ignores the instruction cannot get below 1 / 7: one of seven numbers is 1 or -1, evenly
    while sum(losses[-5:]) / 5 > 0.05 and trainer.step < 250:
        losses.append(trainer.train_step())
    sample = demos.windows(torch.tensor([[0, 1]]), [keys.IMAGE, keys.WRIST_IMAGE, keys.STATE])
    with torch.no_grad():
        up = trainer.policy(sample.clone())[keys.CHUNK]
        down = trainer.policy(sample.set(keys.INSTRUCTION, ["lower the cube"]))[keys.CHUNK]
    assert (up[..., 2] > 0.3).all()
    assert (down[..., 2] < -0.3).all()
