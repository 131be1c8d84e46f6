"""The cameras' encoder: its published size, crops, keypoints, and bad images."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, TransformerForDiffusion, keys
from torchrl_sparse.networks.diffusion.vision import (
    VisionEncoder,
    crop_centre,
    crop_random,
    spatial_softmax,
)

SMALL = {"image_size": (40, 44), "crop_size": (34, 40), "width": 16}


def images(*batch, size=(40, 44), seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(256, (*batch, 3, *size), dtype=torch.uint8, generator=generator)


def test_two_cameras_have_the_published_number_of_parameters():
    with torch.device("meta"):
        vision = VisionEncoder(["image", "wrist_image"])
    assert sum(p.numel() for p in vision.parameters()) == 22_394_176
    assert vision.feature_dim == 128


def test_random_crops_are_parts_of_their_own_image_at_different_places():
    pictures = torch.arange(40 * 3 * 8 * 9).view(40, 3, 8, 9)
    torch.manual_seed(0)
    crops = crop_random(pictures, (4, 6))
    places = set()
    for picture, crop in zip(pictures, crops, strict=True):
        top, left = divmod(int(crop[0, 0, 0] - picture[0, 0, 0]), 9)
        assert torch.equal(crop, picture[:, top : top + 4, left : left + 6])
        places.add((top, left))
    assert {top for top, _ in places} == set(range(5))
    assert {left for _, left in places} == set(range(4))


def test_the_centre_is_cropped_as_published():
    picture = torch.arange(84 * 84).view(1, 1, 84, 84)
    assert crop_centre(picture, (76, 76))[0, 0, 0, 0] == 4 * 84 + 4


def test_keypoints_are_the_mean_place_under_the_softmax():
    maps = torch.randn(2, 3, 4, 5)
    expected = torch.zeros(2, 3, 2)
    for row in range(4):
        for column in range(5):
            place = torch.tensor([-1 + 2 * column / 4, -1 + 2 * row / 3])
            expected += maps.flatten(2).softmax(-1).view(2, 3, 4, 5)[:, :, row, column, None] * place
    torch.testing.assert_close(spatial_softmax(maps), expected)


def test_crops_are_random_in_training_alone():
    vision = VisionEncoder(["image"], **SMALL)
    batch = {"image": images(6, 2)}
    torch.manual_seed(0)
    assert torch.equal(vision.eval()(batch), vision(batch))
    assert not torch.equal(vision.train()(batch), vision(batch))


def test_each_camera_has_weights_of_its_own():
    vision = VisionEncoder(["image", "wrist_image"], **SMALL).eval()
    same = {name: images(4) for name in vision.cameras}
    features = vision(same)
    assert features.shape == (4, 128)
    assert not torch.equal(features[:, :64], features[:, 64:])


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        (images(2, size=(40, 40)), "image 'image'"),
        (images(2).float(), "image 'image'"),
    ],
)
def test_bad_images_are_named(value, entry):
    with refused(entry):
        VisionEncoder(["image"], **SMALL)({"image": value})


@pytest.mark.parametrize(
    ("arguments", "entry"),
    [
        ({"cameras": []}, "cameras"),
        ({"cameras": ["a", "a"]}, "cameras"),
        ({"cameras": ["a"], "crop_size": (85, 76)}, "crop_size"),
        ({"cameras": ["a"], "crop_size": (76,)}, "crop_size"),
        ({"cameras": ["a"], "crop_size": (76, 32)}, "crop_size"),
        ({"cameras": ["a"], "width": 24}, "width"),
    ],
)
def test_bad_sizes_are_named(arguments, entry):
    with refused(entry):
        VisionEncoder(**arguments)


@pytest.fixture
def policy():
    torch.manual_seed(0)
    sizes = {"input_dim": 4, "output_dim": 4, "horizon": 6, "n_obs_steps": 2, "n_layer": 1, "n_emb": 16}
    network = TransformerForDiffusion(**sizes, cond_dim=64 + 5)
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    vision = VisionEncoder(["image"], **SMALL)
    return DiffusionPolicy(network, normalizer, vision=vision, sampler=Sampler("ddim", 4))


def request(*batch):
    td = TensorDict({keys.HISTORY_STATE: torch.zeros(*batch, 2, 5)}, batch)
    td[keys.history("image")] = images(*batch, 2)
    td[keys.EPISODE_SEED] = torch.arange(td.numel()).reshape(*batch, 1)
    return td.set(keys.EPISODE_STEP, torch.zeros(*batch, 1, dtype=torch.int64))


def test_a_policy_sees_its_images(policy):
    with torch.no_grad():  # an untrained network hardly listens
        policy.network.cond_obs_emb.weight *= 30
        policy.vision.encoders["image"].keypoints.weight *= 30
    td = request(3)
    chunk = policy(td.clone())[keys.CHUNK]
    other = td.clone().set(keys.history("image"), images(3, 2, seed=1))
    assert (policy(other)[keys.CHUNK] - chunk).abs().max() > 1e-4
    alone = policy(td[1].clone())
    torch.testing.assert_close(alone[keys.CHUNK], chunk[1], atol=1e-5, rtol=0)


def test_gradients_reach_the_encoder_in_training_and_no_graph_is_kept_in_use(policy):
    policy.train()(request(2))[keys.CHUNK].sum().backward()
    assert policy.vision.encoders["image"].trunk[0].weight.grad.abs().sum() > 0
    assert not policy.eval()(request(2))[keys.CHUNK].requires_grad


def test_sizes_that_do_not_fit_are_named(policy):
    with refused("network"):
        DiffusionPolicy(policy.network, policy.normalizer)
    with pytest.raises(KeyError, match=r"expected the key \('history', 'image'\), got"):
        policy(request(2).exclude(keys.history("image")))
