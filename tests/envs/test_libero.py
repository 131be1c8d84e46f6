"""What stands between LIBERO and a policy; LIBERO itself where it is installed."""

import importlib.util

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_sparse import keys
from torchrl_sparse.envs.libero import SUITES, make_libero_env, rotation_vector

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
    with pytest.raises(ValueError, match=r"suite: expected one of libero_spatial, .*, got 'libero_90'"):
        make_libero_env("libero_90", 0)


@pytest.mark.skipif(importlib.util.find_spec("libero") is not None, reason="LIBERO is there")
def test_the_missing_extra_is_named():
    with pytest.raises(ImportError, match=r"pip install 'torchrl-sparse\[libero\]'"):
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
