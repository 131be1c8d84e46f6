"""The loss, what windows hold, resuming to the last bit, and that the instruction can be learned."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.networks.vla.adapters import add_adapters
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import AdaptedBase
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.vla.grounding import GroundingConfig, ObjectPositions
from torchrl_sparse.training.vla.loss import VLALoss
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations, VLATrainer

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

    def make(demos=demos, grounding=None, **changes):
        torch.manual_seed(0)
        tokenizer = WordTokenizer(["lift", "lower", "cube"])
        policy = VLAPolicy(VLANetwork(config), QuantileNormalizer.identity(8, 7), tokenizer)
        options = {"max_steps": 6, "batch_size": 4, "lr": 1e-3, "lr_warmup_steps": 2, "val_ratio": 0.3}
        return VLATrainer(policy, demos, TrainConfig(**{**options, **changes}), grounding)

    return make


def run(trainer, until):
    return [trainer.train_step()["loss"] for _ in range(until - trainer.step)]


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


def test_a_chunk_of_another_length_is_named(policy, query):
    td = query(3).set(keys.CHUNK, torch.zeros(3, 4, 7))
    with refused("('vla_action', 'chunk')"):
        VLALoss(policy)(td)


def test_windows_stay_in_their_episode_and_carry_its_instruction(demos):
    rows = demos.episodes.window_rows(2, 1, 2)
    sample = demos.windows(rows, [keys.IMAGE, keys.STATE])
    assert len(rows) == 30
    assert sample[keys.IS_PAD].nonzero().tolist() == [[row, 1] for row in (4, 9, 13, 17, 23, 29)]
    up = torch.tensor(["lift" in text for text in sample[keys.INSTRUCTION]])
    assert torch.equal(sample[keys.CHUNK][..., 2] > 0, up[:, None].expand(-1, 2))


def test_one_instruction_for_each_episode(demos):
    with refused("instructions"):
        InstructedDemonstrations(demos.episodes, ["lift", "lower"])


def test_resumed_training_equals_an_unbroken_one_to_the_last_bit(make_trainer, tmp_path):
    unbroken, first, second = make_trainer(), make_trainer(), make_trainer()
    losses = run(unbroken, 6)
    begun = run(first, 3)
    first.save(tmp_path / "checkpoint.pt")
    second.load(tmp_path / "checkpoint.pt")
    assert begun + run(second, 6) == losses
    for ours, theirs in ((second.module, unbroken.module), (second.averaged(), unbroken.averaged())):
        assert all(torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True))


@pytest.fixture
def things(demos):
    """Two objects, whose places can be seen in the frames; their order tells which instruction names which."""
    frame = torch.cat([torch.arange(length) for length in demos.episodes.starts.diff().tolist()])
    place = torch.stack([frame % 2, frame % 3, 0 * frame], 1).float()
    return ObjectPositions(torch.stack([place, 1 - place], 1), ["lift the cube", "lower the cube"])


def test_stages_come_before_the_actions_and_leave_the_policy_as_it_was_built(make_trainer, demos, things):
    options = {"max_steps": 200, "batch_size": 8, "val_ratio": 0.0, "lr": 3e-3}
    trainer = make_trainer(replace(demos, objects=things), GroundingConfig(100, 97), **options)
    network = trainer.policy.network

    def learn(steps):
        before = {name: value.clone() for name, value in network.named_parameters()}
        losses = run(trainer, trainer.step + steps)
        changed = {
            name.split(".")[0] for name, value in network.named_parameters() if (value != before[name]).any()
        }
        return changed, sum(losses[-5:]) / sum(losses[:5])

    changed, left = learn(100)
    assert changed == {"vision", "projector"}
    assert left < 0.5
    changed, left = learn(97)
    assert {"vision", "decoder"} <= changed
    assert "head" not in changed
    assert left < 0.8
    assert "head" in learn(3)[0]
    assert trainer.averaged().state_dict().keys() == network.state_dict().keys()


def test_training_adapters_resumes_to_the_last_bit_and_leaves_the_rest(make_trainer, tmp_path):
    def make():
        trainer = make_trainer()
        torch.manual_seed(1)
        policy = VLAPolicy(add_adapters(trainer.policy.network, 2), tokenizer=trainer.policy.tokenizer)
        policy.base = AdaptedBase("0", 2)
        return VLATrainer(policy, trainer.demos, trainer.config)

    unbroken, first, second = make(), make(), make()
    before = {name: value.clone() for name, value in unbroken.policy.network.named_parameters()}
    losses = run(unbroken, 6)
    begun = run(first, 3)
    first.save(tmp_path / "checkpoint.pt")
    assert not any("embed_tokens" in name for name in first.state()["network"])
    second.load(tmp_path / "checkpoint.pt")
    assert begun + run(second, 6) == losses
    for ours, theirs in ((second.module, unbroken.module), (second.averaged(), unbroken.averaged())):
        assert all(torch.equal(a, b) for a, b in zip(ours.parameters(), theirs.parameters(), strict=True))
    for name, value in unbroken.policy.network.named_parameters():
        assert torch.equal(value, before[name]) == (not value.requires_grad) or "mask_token" in name, name
    other = make()
    other.policy.base = AdaptedBase("1", 2)
    with refused("checkpoint.pt"):
        other.load(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize(("warmup", "first"), [(0, 1.0), (2, 0.0)])
def test_warm_up_begins_at_nothing_unless_there_is_none(make_trainer, warmup, first):
    assert make_trainer(lr_warmup_steps=warmup).lr == 1e-3 * first


def test_a_training_with_stages_resumes_to_the_last_bit(make_trainer, demos, things, tmp_path):
    settings = (replace(demos, objects=things), GroundingConfig(2, 2))
    unbroken, first, second = (make_trainer(*settings) for _ in range(3))
    losses = run(unbroken, 6)
    begun = run(first, 3)
    first.save(tmp_path / "checkpoint.pt")
    second.load(tmp_path / "checkpoint.pt")
    assert begun + run(second, 6) == losses
    with refused("checkpoint.pt"):
        make_trainer(settings[0], GroundingConfig(1, 3)).load(tmp_path / "checkpoint.pt")


def test_stages_without_positions_are_refused(make_trainer):
    with refused("grounding"):
        make_trainer(grounding=GroundingConfig(locate_steps=5))
    with refused("locate_steps, refer_steps"):
        GroundingConfig(locate_steps=-1)
    with refused("positions"):
        ObjectPositions(torch.zeros(5, 3, 3), ["lift", "lower"])


@pytest.mark.parametrize("steps", [1, 5])
def test_objects_that_nothing_moves_cannot_be_located(steps):
    """Their deviation is zero, by which positions were divided."""
    still = ObjectPositions(torch.full((steps, 1, 3), 0.8), ["lift"])
    with refused("object_positions"):
        still.standardised()
    apart = ObjectPositions(torch.tensor([[[0.0, 0, 0], [0.2, 0, 0]]]).expand(steps, 2, 3), ["lift", "lower"])
    assert apart.standardised().positions.isfinite().all()


def test_a_checkpoint_of_another_training_is_refused(make_trainer, tmp_path):
    trainer = make_trainer()
    trainer.save(tmp_path / "checkpoint.pt")
    with refused("checkpoint.pt"):
        make_trainer(lr=2e-3).load(tmp_path / "checkpoint.pt")


def test_the_instruction_can_be_learned(make_trainer, demos):
    """The frames are the same for both, so no other input tells up from down."""
    options = {"batch_size": 8, "lr": 3e-3, "lr_warmup_steps": 10, "val_ratio": 0.0, "max_grad_norm": 1.0}
    trainer, losses = make_trainer(max_steps=300, **options), [1.0] * 5
    # whoever ignores the instruction cannot get below 1 / 7: one of seven numbers is 1 or -1, evenly
    while sum(losses[-5:]) / 5 > 0.05 and trainer.step < 250:
        losses.append(trainer.train_step()["loss"])
    sample = demos.windows(torch.tensor([[0, 1]]), [keys.IMAGE, keys.WRIST_IMAGE, keys.STATE])
    with torch.no_grad():
        up = trainer.policy(sample.clone())[keys.CHUNK]
        down = trainer.policy(sample.set(keys.INSTRUCTION, ["lower the cube"]))[keys.CHUNK]
    assert (up[..., 2] > 0.3).all()
    assert (down[..., 2] < -0.3).all()
