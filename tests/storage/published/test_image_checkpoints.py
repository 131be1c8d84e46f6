"""Published image checkpoints: the same features, the same chain, in every engine and under every planner."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Uniform, keys
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.storage.published.faults import CheckpointError

from .checkpoints import put_config, write_checkpoint
from .image_checkpoints import TRANSPORT, ImagePolicy, image_config

ENGINES = ["reference", "torch"] + ["native"] * native_available()[0]


@pytest.fixture(scope="module")
def published():
    return ImagePolicy()


@pytest.fixture(scope="module")
def checkpoint(published, tmp_path_factory):
    path = tmp_path_factory.mktemp("published") / "image.ckpt"
    return write_checkpoint(path, published, make_config=image_config)


def observe(policy, published, batch):
    """The same observations for both: a TensorDict, and what robomimic calls them."""
    generator = torch.Generator().manual_seed(1)
    td = TensorDict({keys.EPISODE_SEED: torch.arange(batch)[:, None]}, [batch])
    td[keys.EPISODE_STEP] = torch.zeros(batch, 1, dtype=torch.int64)
    theirs = {}
    for name, key in policy.source["cameras"].items():
        image = torch.randint(256, (batch, 2, 3, 84, 84), dtype=torch.uint8, generator=generator)
        image[..., :40, :] //= 3
        td[keys.history(name)], theirs[key] = image, image / 255
    sizes = [published.shape_meta[key][0] for key in policy.source["state_keys"]]
    td[keys.HISTORY_STATE] = torch.randn(batch, 2, sum(sizes), generator=generator)
    states = td[keys.HISTORY_STATE].split(sizes, -1)
    return td, theirs | dict(zip(policy.source["state_keys"], states, strict=True))


def test_layout(published, checkpoint):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint)
    assert policy.network.cond_dim == 137
    assert policy.source["cameras"] == {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
    assert policy.source["state_keys"] == ["robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"]
    assert policy.vision.config["crop_size"] == [76, 76]
    assert policy.source["n_action_steps"] == 8
    image, wrist = ("history", "image"), ("history", "wrist_image")
    assert policy.in_keys[:3] == [keys.HISTORY_STATE, image, wrist]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_chain_of_100_steps_is_the_published_one(published, checkpoint, engine):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint, engine=engine)
    td, theirs = observe(policy, published, 2)
    policy(td)
    cond = published.cond(theirs)
    assert cond[..., :128].std(0).mean() > 1e-3  # features tell the pictures apart
    # packed convolutions sum in another order
    torch.testing.assert_close(td[keys.COND], cond, atol=1e-5, rtol=0)
    sample = torch.randn(2, 10, 10)
    with torch.no_grad():
        eps = policy.network(sample, 50, cond)
    assert (eps - published.model(sample, 50, cond)).abs().max() <= 1e-6
    expected = published.chain(policy.sample_noise(td[keys.SEED].squeeze(-1)), cond)
    chunk = policy.normalizer.normalize_action(td[keys.CHUNK])
    assert (chunk - expected[:, 1:]).abs().max() <= 1e-5


@pytest.mark.parametrize("engine", ENGINES)
def test_a_planner_runs_on_it(published, checkpoint, engine):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint, engine=engine)
    policy.plan = Uniform(10)
    td, _ = observe(policy, published, 3)
    together = policy(td.clone())[keys.CHUNK]
    torch.testing.assert_close(policy(td[1:2].clone())[keys.CHUNK], together[1:2], atol=1e-5, rtol=0)
    # Or every policy call would fall back to the differentiable engine.
    assert policy.module["encode"](td)[keys.COND].requires_grad is False


def test_observations_of_two_arms_come_in_another_order(tmp_path):
    published = ImagePolicy(TRANSPORT)
    path = write_checkpoint(tmp_path / "a.ckpt", published, make_config=image_config)
    policy = DiffusionPolicy.from_diffusion_policy(path)
    assert list(policy.source["cameras"]) == [
        "image",
        "wrist_image",
        "shouldercamera1_image",
        "robot1_eye_in_hand_image",
    ]
    td, theirs = observe(policy, published, 2)
    sample = torch.randn(2, 10, 10)
    with torch.no_grad():
        found = policy.network(sample, 5, policy.module["encode"](td)[keys.COND])
    assert (found - published.model(sample, 5, published.cond(theirs))).abs().max() <= 2e-6


def test_round_trip_through_our_own_files(published, checkpoint, tmp_path):
    policy = DiffusionPolicy.from_diffusion_policy(checkpoint)
    policy.save_pretrained(tmp_path, half=False)
    again = DiffusionPolicy.from_pretrained(tmp_path)
    assert again.fingerprint == policy.fingerprint
    td, _ = observe(policy, published, 1)
    assert torch.equal(again(td.clone())[keys.CHUNK], policy(td.clone())[keys.CHUNK])
    with torch.no_grad():
        policy.vision.encoders["image"].linear.bias += 1
    assert again.fingerprint != policy.fingerprint


def weight(name, value):
    return lambda payload: payload["state_dicts"]["ema_model"].update({name: value})


def endless_keypoints(payload):
    """A grid of 300,000 x 300,000 places, told by its edges."""
    for axis in ("pos_x", "pos_y"):
        weight(f"{CAMERA}nets.1.{axis}", torch.linspace(-1, 1, 300_000)[None])(payload)


CAMERA = "obs_encoder.obs_nets.agentview_image."
FAULTS = {
    "random crops in use": (
        put_config("policy.eval_fixed_crop", False),
        "bad.ckpt: cfg: policy.eval_fixed_crop",
    ),
    "crop beyond the image": (
        put_config("policy.crop_shape", [90, 90]),
        "bad.ckpt: crop_size",
    ),
    "crop of words": (put_config("policy.crop_shape", ["a", "b"]), "bad.ckpt: cfg: policy.crop_shape"),
    "state of two axes": (
        put_config("task.shape_meta.obs.robot0_eef_pos.shape", [3, 3]),
        "bad.ckpt: cfg: shape_meta: robot0_eef_pos",
    ),
    "images of several sizes": (
        put_config("task.shape_meta.obs.agentview_image.shape", [3, 64, 64]),
        "bad.ckpt: cfg: shape_meta",
    ),
    "a camera without weights": (
        put_config("task.shape_meta.obs.extra_image", {"shape": [3, 84, 84], "type": "rgb"}),
        "bad.ckpt: obs_encoder: extra_image",
    ),
    "batch norm": (weight(f"{CAMERA}nets.0.nets.1.running_mean", torch.zeros(16)), "bad.ckpt"),
    "another temperature": (
        weight(f"{CAMERA}nets.1.temperature", torch.tensor([2.0])),
        "bad.ckpt: obs_encoder: agentview_image",
    ),
    "another grid": (
        weight(f"{CAMERA}nets.1.pos_x", torch.zeros(1, 9)),
        "bad.ckpt: obs_encoder: agentview_image",
    ),
    "a grid far larger than the file": (endless_keypoints, "bad.ckpt: obs_encoder: agentview_image"),
    "a state far larger than the file": (
        put_config("task.shape_meta.obs.robot0_eef_pos.shape", [10**12]),
        "bad.ckpt",
    ),
    "another normalisation": (
        weight("normalizer.params_dict.agentview_image.scale", torch.tensor([1.0])),
        "bad.ckpt: normalizer: agentview_image",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_checkpoint_is_named(published, tmp_path, fault):
    change, message = FAULTS[fault]
    path = write_checkpoint(tmp_path / "bad.ckpt", published, change=change, make_config=image_config)
    with refused(message, CheckpointError):
        DiffusionPolicy.from_diffusion_policy(path)
