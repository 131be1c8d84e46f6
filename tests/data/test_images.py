"""Images of demonstration files: values, order, memory-mapped files, and files that are wrong."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.data.big_files import write_big
from tests.fixtures.demonstrations import describe
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import read_demos

LENGTHS = (5, 3, 8)
CAMERAS = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}


def write(path, lengths=LENGTHS, frame=(6, 8), seed=0):
    random = np.random.default_rng(seed)
    with h5py.File(path, "w") as file:
        for index, length in enumerate(lengths):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = length
            demo["actions"] = actions = random.uniform(-1, 1, (length, 7))
            demo["obs/robot0_eef_pos"] = actions[:, :3]
            for camera in CAMERAS.values():
                demo[f"obs/{camera}"] = random.integers(0, 256, (length, *frame, 3), dtype=np.uint8)
        describe(file)
    return path


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "demos.h5")


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


@pytest.mark.parametrize("mapped", [False, True])
def test_images_of_several_files_are_laid_end_to_end_with_what_belongs_to_them(path, tmp_path, mapped):
    paths = [path, write(tmp_path / "more.h5", (4, 2), seed=1)]
    alone = [read_demos(each, ["robot0_eef_pos"], cameras=CAMERAS) for each in paths]
    folder = tmp_path / "images" if mapped else None
    both = read_demos(paths, ["robot0_eef_pos"], cameras=CAMERAS, image_folder=folder)
    assert both.starts.diff().tolist() == [*LENGTHS, 4, 2]
    for key in (keys.STATE, keys.ACTION, *(("observation", name) for name in CAMERAS)):
        assert torch.equal(torch.as_tensor(both.data[key]), torch.cat([each.data[key] for each in alone]))


def test_a_later_file_with_other_images_or_none_is_named_and_nothing_is_written(path, tmp_path):
    smaller = write(tmp_path / "smaller.h5", (4,), frame=(6, 6))
    without = write(tmp_path / "without.h5", (4,))
    with h5py.File(without, "r+") as file:
        replaced(None)(file, "demo_0")
    options = {"cameras": CAMERAS, "image_folder": tmp_path / "images"}
    with refused("smaller.h5, demo_0, obs/agentview_image"):
        read_demos([path, smaller], ["robot0_eef_pos"], **options)
    with refused("without.h5, demo_0"):
        read_demos([path, without], ["robot0_eef_pos"], **options)
    assert not list((tmp_path / "images").iterdir())


def replaced(value):
    def change(file, demo="demo_1"):
        del file[f"data/{demo}/obs/agentview_image"]
        if value is not None:
            file[f"data/{demo}/obs/agentview_image"] = value

    return change


@pytest.mark.parametrize(
    ("value", "entry"),
    [
        (None, "demos.h5, demo_1"),
        (
            np.zeros((3, 6, 8, 3), np.float32),
            "demos.h5, demo_1, obs/agentview_image",
        ),
        (
            np.zeros((2, 6, 8, 3), np.uint8),
            "demos.h5, demo_1, obs/agentview_image",
        ),
        (
            np.zeros((3, 6, 6, 3), np.uint8),
            "demos.h5, demo_1, obs/agentview_image",
        ),
    ],
)
def test_a_wrong_file_names_the_demonstration(path, value, entry):
    with h5py.File(path, "r+") as file:
        replaced(value)(file)
    with refused(entry):
        read_demos(path, ["robot0_eef_pos"], cameras=CAMERAS)
    with refused(entry):
        read_demos(path, ["robot0_eef_pos"], cameras=CAMERAS, image_folder=path.parent / "images")
    assert not list((path.parent / "images").glob("*agentview*"))


def test_images_that_are_read_again_replace_the_old_ones_at_once(path, tmp_path):
    read = {"cameras": CAMERAS, "image_folder": tmp_path / "images"}
    in_use = read_demos(path, ["robot0_eef_pos"], **read).data["observation", "image"]
    before = in_use.clone()
    with h5py.File(path, "r+") as file:
        file["data/demo_0/obs/agentview_image"][...] = 7
    again = read_demos(path, ["robot0_eef_pos"], **read).data["observation", "image"]
    assert (again[: LENGTHS[0]] == 7).all()
    assert torch.equal(in_use, before)


def read_in_a_process(path, folder):
    """Peak memory before and after reading, and the size of the images, MB."""
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, root / "tests/data/big_files.py", path, folder]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return [int(number) / 1e6 for number in done.stdout.split()]


def test_reading_takes_the_memory_of_one_demonstration(tmp_path):
    path = write_big(tmp_path / "images.hdf5", demos=60, length=200)
    before, after, size = read_in_a_process(path, tmp_path)
    assert size > 250
    assert after - before < 100


@pytest.mark.slow
def test_five_gigabytes_are_read_with_less_than_one(tmp_path):
    path = write_big(tmp_path / "images.hdf5", demos=240, length=1000)
    _, peak, size = read_in_a_process(path, tmp_path)
    for file in tmp_path.iterdir():
        file.unlink()
    assert size > 5000
    assert peak < 1000
