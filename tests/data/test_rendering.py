"""Rendering recorded states gives the pictures that the policy would have seen; skipped only without a GL library."""

import h5py
import numpy as np
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import keys, make_env
from torchrl_sparse.data.demos import Collection, collect, read_initial_state
from torchrl_sparse.data.rendering import render_demos
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.rotations import pose_to_absolute

CAMERAS = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    collect(folder / "lift.h5", Collection("Lift", episodes=1, seed=50))
    with h5py.File(folder / "lift.h5", "r+") as file:
        file["mask/train"] = np.array(["demo_0"], dtype="S8")
    try:
        render_demos(
            folder / "lift.h5", folder / "images.h5", ["agentview", "robot0_eye_in_hand"], image_size=32
        )
    except RuntimeError as error:
        pytest.skip(str(error))
    return folder / "lift.h5", folder / "images.h5"


def distance(picture, other):
    """Mean difference in grey levels."""
    return (picture.float() - other.float()).abs().mean().item()


def test_pictures_are_those_of_the_environment(files):
    plain, with_images = files
    camera_args = {"camera": "agentview", "wrist_camera": "robot0_eye_in_hand", "image_size": 32}
    env = make_env("Lift", object_state=False, **camera_args)
    demos = read_demos(with_images, find_robosuite_task("Lift").proprioception_keys, cameras=CAMERAS)
    with h5py.File(plain) as file:
        executed = file["data/demo_0/executed_actions"][:6]
    td = env.reset(initial_state=read_initial_state(plain, 0))
    history = [td["history", "image"]]
    for row, action in enumerate(executed):
        for name in CAMERAS:
            rendered = demos.data["observation", name]
            # MuJoCo's poses are those before the last physics step of 2 ms, recorded states those after it.
            assert distance(td["observation", name], rendered[row]) < 2
            assert row > 0 or torch.equal(td["observation", name], rendered[row])
        wrist = demos.data["observation", "wrist_image"]
        nearest = [distance(td["observation", "wrist_image"], picture) for picture in wrist[:12]]
        assert nearest.index(min(nearest)) == row
        torch.testing.assert_close(td[keys.STATE], demos.data[keys.STATE][row], atol=1e-5, rtol=0)
        td[keys.ACTION] = torch.as_tensor(pose_to_absolute(action), dtype=torch.float32)
        td = env.step(td)["next"]
        history.append(td["history", "image"])
    assert torch.equal(history[0][0], history[0][1])
    assert torch.equal(history[5][0], history[4][1])
    assert td[keys.STATE].shape == (9,)
    env.close()


def test_everything_else_is_copied_and_the_file_is_never_its_own_source(files):
    plain, rendered = files
    with h5py.File(plain) as one, h5py.File(rendered) as other:
        assert dict(one["data"].attrs) == dict(other["data"].attrs)
        assert other["mask/train"][()].tolist() == [b"demo_0"]
        np.testing.assert_array_equal(one["data/demo_0/states"], other["data/demo_0/states"])
        assert other["data/demo_0/obs/agentview_image"].shape[1:] == (32, 32, 3)
        cube = other["data/demo_0/obs/object_positions"][()]
        np.testing.assert_allclose(cube, one["data/demo_0/obs/object"][:, :3], atol=2e-3)
    with refused("out"):
        render_demos(plain, plain, ["agentview"])


def test_an_unknown_camera_is_named_and_leaves_no_file(files, tmp_path):
    with refused("camera"):
        render_demos(files[0], tmp_path / "out.h5", ["nowhere"])
    assert not list(tmp_path.iterdir())
