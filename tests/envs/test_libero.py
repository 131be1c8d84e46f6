"""What stands between LIBERO and a policy; LIBERO itself where it is installed."""

import importlib.util
import io
from contextlib import nullcontext

import imageio.v3 as iio
import pytest
import torch
from PIL import Image
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, NonTensor, Unbounded
from torchrl.data.vla import preprocessing
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.envs import libero
from torchrl_sparse.envs.libero import SUITES, make_libero_env, rotation_vector
from torchrl_sparse.envs.release_images import ReleaseImages, as_released
from torchrl_sparse.networks.vla.vision import center_crop

needs_libero = pytest.mark.skipif(importlib.util.find_spec("libero") is None, reason="no LIBERO")


def test_rotation_vectors_follow_the_sign_of_the_quaternion():
    half = torch.tensor(0.5).sqrt()
    quaternions = torch.stack(
        [
            torch.tensor([0.0, 0.0, 0.0, 1.0]),
            torch.stack([half, half * 0, half * 0, half]),
            -torch.stack([half, half * 0, half * 0, half]),
        ]
    )
    vectors = rotation_vector(quaternions)
    expected = torch.tensor([[0.0, 0, 0], [torch.pi / 2, 0, 0], [-3 * torch.pi / 2, 0, 0]])
    torch.testing.assert_close(vectors, expected)


def test_unknown_suites_are_refused():
    with refused("suite"):
        make_libero_env("libero_90", 0)


@pytest.mark.skipif(importlib.util.find_spec("libero") is not None, reason="LIBERO is there")
def test_the_missing_extra_is_named():
    with pytest.raises(ImportError, match=r"pip install 'torchrl-sparse\[libero\]'"):
        make_libero_env("libero_goal", 0)


def test_scenes_that_are_not_linked_are_named(monkeypatch):
    def without_scenes(*args, **options):
        raise FileNotFoundError(2, "No such file or directory", "assets/scenes/kitchen.xml")

    monkeypatch.setattr(libero, "_MountedLibero", without_scenes)
    monkeypatch.setattr(libero, "_base_of_floor_robots", nullcontext)
    with refused("LIBERO's scenes", FileNotFoundError):
        make_libero_env("libero_goal", 0)


@needs_libero
def test_a_task_gives_what_the_policy_and_the_controller_read():
    env = make_libero_env("libero_object", 0, image_size=28, max_episode_steps=2, settle_steps=0)
    check_env_specs(env)
    steps = env.rollout(3)
    assert len(steps) == 2
    assert steps["next", "truncated"].flatten().tolist() == [False, True]
    assert steps[keys.IS_INIT].flatten().tolist() == [True, False]
    for camera in (keys.IMAGE, keys.WRIST_IMAGE):
        assert steps[camera].shape == (2, 3, 28, 28)
        assert steps[camera].float().std() > 10
    pose, state = steps["observation", "pose"], steps[keys.STATE]
    assert torch.equal(state, torch.cat([pose[..., :3], rotation_vector(pose[..., 3:7]), pose[..., 7:]], -1))
    moved = steps["next", "observation", "pose"][0, :3] - pose[0, :3]
    torch.testing.assert_close(steps[keys.EEF_VEL][1, :3], 20 * moved)
    assert set(SUITES) == {"libero_spatial", "libero_object", "libero_goal", "libero_10"}


class StillScene(EnvBase):
    """What `make_libero_env` gives, of a scene in which nothing ever happens."""

    def __init__(self, image_size):
        super().__init__(batch_size=[])
        image = Unbounded((3, image_size, image_size), dtype=torch.uint8)
        observation = {
            "image": image,
            "wrist_image": image.clone(),
            "state": Unbounded(8),
            "eef_vel": Unbounded(6),
        }
        self.observation_spec = Composite(
            observation=Composite(observation),
            success=Categorical(2, (1,), dtype=torch.bool),
            language_instruction=NonTensor((), example_data="wait"),
        )
        self.action_spec, self.reward_spec = Bounded(-1, 1, (7,)), Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        return self.observation_spec.zero().set(keys.INSTRUCTION, "wait")

    def _step(self, tensordict):
        over = {"reward": torch.zeros(1), "done": torch.zeros(1, dtype=torch.bool)}
        return self._reset().update(TensorDict(over))

    def _set_seed(self, seed):
        pass


class Rendered(StillScene):
    """The same with noise for pictures."""

    def _reset(self, tensordict=None, **kwargs):
        td = super()._reset()
        generator = torch.Generator().manual_seed(0)
        for camera in (keys.IMAGE, keys.WRIST_IMAGE):
            shape = td[camera].shape
            td[camera] = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        return td


def test_images_go_the_way_of_the_release():
    """A wave that both sizes can show stays; one pixel wide stripes do not pass the filter."""
    ramp = torch.linspace(40, 200, 256).round().byte().expand(3, 256, 256)
    expected = torch.linspace(40, 200, 224).expand(3, 224, 224)
    assert (as_released(ramp, 224).float() - expected)[..., 4:-4].abs().max() < 3
    stripes = (torch.arange(256) % 2 * 200).byte().expand(3, 256, 256)
    assert as_released(stripes, 56).float()[..., 4:-4].std() < 3  # aliased, they would be 0 or 200
    env = TransformedEnv(Rendered(256), ReleaseImages([keys.IMAGE, keys.WRIST_IMAGE], 28))
    check_env_specs(env)
    steps, raw = env.rollout(2), Rendered(256).reset()
    for camera in (keys.IMAGE, keys.WRIST_IMAGE):
        assert torch.equal(steps[camera][0], as_released(raw[camera], 28))


def test_images_are_those_of_torchrls_preprocessor():
    """The parts of `OpenVLAImagePreprocessor` that follow TensorFlow, on a picture with noise in every pixel."""
    torch.manual_seed(0)
    image = torch.rand(3, 16, 16).repeat_interleave(16, 1).repeat_interleave(16, 2)
    image = ((image + torch.rand(3, 256, 256) / 4) * 200).byte()
    file = io.BytesIO()
    Image.fromarray(image.permute(1, 2, 0).numpy()).save(file, "JPEG", quality=95)
    decoded = torch.from_numpy(iio.imread(file.getvalue(), extension=".jpg")).permute(2, 0, 1)
    whole = preprocessing._lanczos3_resize(decoded[None].float(), (224, 224)).round().clamp(0, 255).byte()
    cropped = preprocessing._fractional_center_crop(whole, (224, 224))
    ours = as_released(image, 224)[None]
    for mine, theirs in ((ours, whole), (center_crop(ours, 0.9), cropped)):
        difference = (mine.float() - theirs.float()).abs()
        assert difference.max() <= 2
        assert difference.mean() < 0.3  # Pillow rounds between its two passes
