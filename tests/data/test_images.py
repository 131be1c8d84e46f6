"""Images of demonstration files: values, order, memory-mapped files, and files that are wrong."""

import h5py
import numpy as np
import pytest
import torch

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import read_demos

LENGTHS = (5, 3, 8)
CAMERAS = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}


@pytest.fixture
def path(tmp_path):
    random = np.random.default_rng(0)
    with h5py.File(tmp_path / "demos.h5", "w") as file:
        for index, length in enumerate(LENGTHS):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = length
            demo["actions"] = random.uniform(-1, 1, (length, 7))
            demo["obs/robot0_eef_pos"] = random.uniform(-1, 1, (length, 3))
            for camera in CAMERAS.values():
                demo[f"obs/{camera}"] = random.integers(0, 256, (length, 6, 8, 3), dtype=np.uint8)
    return tmp_path / "demos.h5"


@pytest.mark.parametrize("mapped", [False, True])
def test_images_come_with_the_channels_first(path, tmp_path, mapped):
    folder = tmp_path / "images" if mapped else None
    demos = read_demos(path, ["robot0_eef_pos"], cameras=CAMERAS, image_folder=folder)
    with h5py.File(path) as file:
        for name, camera in CAMERAS.items():
            for index in range(len(LENGTHS)):
                found = demos.episode(index)["observation", name]
                expected = torch.from_numpy(file[f"data/demo_{index}/obs/{camera}"][:]).permute(0, 3, 1, 2)
                assert found.dtype == torch.uint8
                assert torch.equal(torch.as_tensor(found), expected)
    if mapped:
        assert sorted(file.name for file in folder.iterdir()) == sorted(
            f"{key}.memmap" for key in CAMERAS.values()
        )
    rows = demos.window_rows(4, 2, 2)
    assert demos.windows(rows, 2)["history", "wrist_image"].shape == (len(rows), 2, 3, 6, 8)
    assert demos.windows(rows, 2)[keys.HISTORY_STATE].shape == (len(rows), 2, 3)


def replaced(value):
    def change(file):
        del file["data/demo_1/obs/agentview_image"]
        if value is not None:
            file["data/demo_1/obs/agentview_image"] = value

    return change


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "cannot be read"),
        (np.zeros((3, 6, 8, 3), np.float32), r"expected uint8 \[3, h, w, 3\], got float32"),
        (np.zeros((2, 6, 8, 3), np.uint8), r"expected uint8 \[3, h, w, 3\], got uint8 \[2, 6, 8, 3\]"),
        (np.zeros((3, 6, 6, 3), np.uint8), r"expected images \[3, 6, 8\] as before, got \[3, 6, 6\]"),
    ],
)
def test_a_wrong_file_names_the_demonstration(path, value, message):
    with h5py.File(path, "r+") as file:
        replaced(value)(file)
    with pytest.raises(ValueError, match=rf"demos\.h5, demo_1, obs/agentview_image: {message}"):
        read_demos(path, ["robot0_eef_pos"], cameras=CAMERAS)
