"""Cameras' features from packed weights are those of the encoder, follow its weights, and give way where somebody looks."""

import copy
import gc
import pickle

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.networks.diffusion.packed_vision import can_pack_vision, pack_vision
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.policies.diffusion import cameras
from torchrl_sparse.policies.diffusion.cameras import CameraSlot

SMALL = {"image_size": (40, 44), "crop_size": (34, 40), "width": 16}
CAMERAS = ("image", "wrist_image")


def make_vision(**changes):
    torch.manual_seed(0)
    return VisionEncoder(CAMERAS, **SMALL | changes).eval()


def make_frames(*batch, size=(40, 44)):
    generator = torch.Generator().manual_seed(1)
    return {
        name: torch.randint(256, (*batch, 3, *size), dtype=torch.uint8, generator=generator)
        for name in CAMERAS
    }


needs_packing = pytest.mark.skipif(not can_pack_vision(make_vision()), reason="PyTorch without oneDNN")


@needs_packing
@pytest.mark.parametrize(
    "sizes", [{}, {"width": 32}, {"image_size": (84, 84), "crop_size": (76, 76), "width": 64}]
)
@pytest.mark.parametrize("batch", [(2,), (1, 2), (3, 2), (0, 2)])
def test_features_of_packed_weights_are_those_of_the_encoder(batch, sizes):
    vision = make_vision(**sizes)
    frames = make_frames(*batch, size=vision.image_size)
    with torch.no_grad():
        expected, got = vision(frames), pack_vision(vision, frames=2)(frames)
    assert got.shape == expected.shape
    torch.testing.assert_close(got, expected, atol=1e-5, rtol=0)


@needs_packing
def test_weights_that_change_are_seen_and_those_that_stay_are_packed_once():
    vision, slot, frames = make_vision(), CameraSlot(), make_frames(1, 2)
    with torch.no_grad():
        packed = slot.get(vision, frames=2)
        assert packed is not vision
        assert slot.get(vision, frames=2) is packed
        before = packed(frames)
        for change in (
            lambda: vision.encoders["image"].trunk[0].weight.mul_(-1),
            lambda: setattr(vision.encoders["wrist_image"], "keypoints", torch.nn.Conv2d(128, 32, 1)),
            lambda: vision.load_state_dict({name: 1.1 * x for name, x in vision.state_dict().items()}),
        ):
            change()
            after = slot.get(vision, frames=2)(frames)
            torch.testing.assert_close(after, vision(frames), atol=1e-5, rtol=0)
            assert (after - before).abs().max() > 1e-4
            before = after
        other = make_vision()
        torch.testing.assert_close(slot.get(other, frames=2)(frames), other(frames), atol=1e-5, rtol=0)


@needs_packing
def test_another_encoder_is_packed_where_the_one_before_is_gone():
    slot, frames = CameraSlot(), make_frames(1, 2)
    with torch.no_grad():
        slot.get(make_vision(), frames=2)
        gc.collect()
        other = make_vision()
        torch.testing.assert_close(slot.get(other, frames=2)(frames), other(frames), atol=1e-5, rtol=0)


@needs_packing
def test_after_a_write_through_data_refresh_packs_anew():
    vision, slot, frames = make_vision(), CameraSlot(), make_frames(1, 2)
    with torch.no_grad():
        slot.get(vision, frames=2)
        vision.encoders["image"].linear.weight.data[5:] *= -2
        slot.refresh()
        torch.testing.assert_close(slot.get(vision, frames=2)(frames), vision(frames), atol=1e-5, rtol=0)


@pytest.mark.parametrize("why", ["gradients", "training", "double", "hook", "subclass"])
def test_the_encoder_itself_runs_where_more_is_asked_than_features(why):
    class Other(VisionEncoder):
        pass

    vision = make_vision()
    if why == "training":
        vision.train()
    if why == "double":
        vision.double()
    if why == "hook":
        vision.encoders["image"].trunk.register_forward_hook(lambda *_: None)
    if why == "subclass":
        vision = Other(CAMERAS, **SMALL).eval()
    with torch.set_grad_enabled(why == "gradients"):
        assert CameraSlot().get(vision, frames=2) is vision


@needs_packing
def test_copies_and_pickles_carry_no_packed_weights():
    vision, slot = make_vision(), CameraSlot()
    with torch.no_grad():
        slot.get(vision, frames=2)
        assert len(pickle.dumps(slot)) < 1000
        packed = slot.get(vision, frames=2)
        assert copy.deepcopy(slot).get(vision, frames=2) is not packed


@needs_packing
def test_a_policy_answers_with_packed_cameras_as_without(make_image_policy, monkeypatch):
    packings = []
    monkeypatch.setattr(
        cameras,
        "pack_vision",
        lambda *args, **options: packings.append(args) or pack_vision(*args, **options),
    )
    policy = make_image_policy()
    query = TensorDict({"history": {"state": torch.rand(2, 2, 3), **make_frames(2, 2)}}, [2])
    query["episode"] = {name: torch.ones(2, 1, dtype=torch.long) for name in ("seed", "step")}
    cond = policy(query.copy())["diffusion", "cond"]  # gradients are on, but weights in use are frozen
    policy(query.copy())
    assert len(packings) == 1
    policy.vision.register_forward_hook(lambda *_: None)
    expected = policy(query.copy())["diffusion", "cond"]
    torch.testing.assert_close(cond, expected, atol=1e-5, rtol=0)


@needs_packing
def test_cameras_round_where_the_engine_does(make_image_policy):
    policy = make_image_policy()
    query = TensorDict({"history": {"state": torch.rand(2, 2, 3), **make_frames(2, 2)}}, [2])
    exact = policy(query.copy())[keys.COND]
    rounded = policy.with_plan(None)  # shares what is packed
    rounded.engine = "native_bf16"
    cond = rounded(query.copy())[keys.COND]
    assert cond.dtype == torch.float32
    assert torch.equal(cond[..., 128:], exact[..., 128:])
    error = (cond - exact)[..., :128].abs().mean() / exact[..., :128].abs().mean()
    assert 1e-4 < error < 0.03
    assert torch.equal(policy(query.copy())[keys.COND], exact)
    assert torch.equal(rounded.with_noise(1)(query.copy())[keys.COND], cond)
    with torch.no_grad():
        policy.vision.encoders["image"].linear.weight.mul_(-1)
    changed = rounded(query.copy())[keys.COND]
    assert not torch.equal(changed[..., :64], cond[..., :64])
    rounded.engine = "native"
    torch.testing.assert_close(rounded(query.copy())[keys.COND], policy(query.copy())[keys.COND])


@needs_packing
def test_what_is_rounded_is_multiplied_on_any_processor(monkeypatch):
    vision, frames = make_vision(), make_frames(3, 2)
    with torch.no_grad():
        exact, here = vision(frames), pack_vision(vision, frames=2, bf16=True)(frames)
        monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: False)
        without = pack_vision(vision, frames=2, bf16=True)(frames)
    assert 0 < (without - exact).abs().mean() < 0.03 * exact.abs().mean()
    torch.testing.assert_close(without, here, atol=0.015, rtol=0)


@needs_packing
def test_methods_of_one_policy_share_what_is_packed(make_image_policy):
    policy = make_image_policy()
    other = policy.with_noise(3)
    with torch.no_grad():
        slots = (p.module["encode"].condition.cameras for p in (policy, other))
        first, second = (slot.get(policy.vision, frames=2) for slot in slots)
    assert first is second
    assert other.noise_stream == 3
