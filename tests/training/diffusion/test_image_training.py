"""Training on images: resume to the last bit, what is trained and saved, files that do not belong."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, TransformerForDiffusion, keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.training.demonstrations import TrainConfig
from torchrl_sparse.training.diffusion.trainer import PolicyTrainer


@pytest.fixture
def demos():
    """Four episodes of nine steps; the action is where the bright column of the picture is, the state says nothing."""
    generator = torch.Generator().manual_seed(0)
    place = torch.randint(36, (36,), generator=generator)
    image = torch.zeros(36, 3, 36, 40, dtype=torch.uint8)
    image[torch.arange(36), :, :, place] = 255
    action = torch.zeros(36, 10)
    action[:, 0] = place / 18 - 1
    data = {keys.STATE: torch.zeros(36, 3), keys.ACTION: action, ("observation", "image"): image}
    return Demonstrations(TensorDict(data, [36]), torch.arange(0, 37, 9))


@pytest.fixture
def make_trainer(demos):
    def make(crop=(34, 36), **changes):
        torch.manual_seed(0)
        vision = VisionEncoder(["image"], image_size=(36, 40), crop_size=crop, width=16)
        sizes = {"input_dim": 10, "output_dim": 10, "horizon": 4, "n_obs_steps": 2, "cond_dim": 64 + 3}
        network = TransformerForDiffusion(**sizes, n_layer=1, n_emb=16)
        normalizer = Normalizer.fit(demos.data[keys.STATE], demos.data[keys.ACTION])
        config = {"max_steps": 6, "batch_size": 4, "n_action_steps": 2, "lr": 1e-3, "lr_warmup_steps": 1}
        policy = DiffusionPolicy(network, normalizer, vision=vision, engine="reference")
        return PolicyTrainer(policy, demos, TrainConfig(**(config | changes)))

    return make


def test_resumed_training_equals_an_unbroken_one_to_the_last_bit(make_trainer, tmp_path):
    unbroken, first, second = make_trainer(), make_trainer(), make_trainer()
    losses = [unbroken.train_step() for _ in range(6)]
    begun = [first.train_step() for _ in range(3)]
    first.save(tmp_path / "checkpoint.pt")
    second.train_step()
    second.load(tmp_path / "checkpoint.pt")
    assert begun + [second.train_step() for _ in range(3)] == losses
    for one, other in (
        (unbroken.vision, second.vision),
        (unbroken.ema_policy().vision, second.ema_policy().vision),
    ):
        assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert second.validate() == unbroken.validate()


def test_the_encoder_and_its_average_are_trained_and_saved(make_trainer, tmp_path):
    trainer = make_trainer()
    before = trainer.vision.encoders["image"].trunk[0].weight.clone()
    trainer.train_step()
    trainer.train_step()
    after = trainer.vision.encoders["image"].trunk[0].weight
    averaged = trainer.ema_policy().vision.encoders["image"].trunk[0].weight
    assert not torch.equal(before, after)
    assert not torch.equal(averaged, after)
    trainer.ema_policy().save_pretrained(tmp_path)
    loaded = DiffusionPolicy.from_pretrained(tmp_path)
    assert torch.equal(loaded.vision.encoders["image"].trunk[0].weight, averaged.half().float())


def test_windows_pair_pictures_with_the_actions_taken_then(demos):
    rows = demos.window_rows(4, 2, 2)
    batch = demos.windows(rows, 2)
    assert batch["history", "image"].shape == (len(rows), 2, 3, 36, 40)
    column = batch["history", "image"][:, 1, 0, 0].float().argmax(-1)
    torch.testing.assert_close(batch[keys.ACTION][:, 1, 0], column / 18 - 1)


def test_loss_falls(make_trainer):
    trainer = make_trainer(max_steps=80, lr=3e-3, batch_size=16, lr_warmup_steps=5)
    losses = [trainer.train_step()["loss"] for _ in range(80)]
    assert sum(losses[-10:]) < 0.8 * sum(losses[:10])


def test_a_checkpoint_of_another_encoder_is_refused(make_trainer, tmp_path):
    make_trainer().save(tmp_path / "checkpoint.pt")
    with refused("checkpoint.pt"):
        make_trainer(crop=(33, 36)).load(tmp_path / "checkpoint.pt")
