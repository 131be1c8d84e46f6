"""What demonstrations were asked to do, as their files tell it."""

import json

import h5py
import pytest

from tests.refusals import refused
from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.instructions import read_instruction, read_instructions


def write(path, metas):
    with h5py.File(path, "w") as file:
        for index, meta in enumerate(metas):
            demo = file.create_group(f"data/demo_{index}")
            if meta is not None:
                demo.attrs["ep_meta"] = meta
    return path


def test_they_come_in_the_order_of_the_demonstrations_numbers(tmp_path):
    words = [f"lift cube {index}" for index in range(12)]
    path = write(tmp_path / "demos.h5", [json.dumps({"lang": each, "layout": 3}) for each in words])
    assert read_instructions(path) == words
    again = write(tmp_path / "more.h5", [json.dumps({"lang": "lift the ball"})])
    assert read_instructions([path, again]) == [*words, "lift the ball"]


@pytest.mark.parametrize("meta", [None, "{}", '{"lang": ""}'])
def test_a_demonstration_without_one_is_named(tmp_path, meta):
    path = write(tmp_path / "demos.h5", ['{"lang": "lift"}', meta])
    with refused("demos.h5, demo_1"):
        read_instructions(path)


@pytest.mark.parametrize("meta", ["{", "[3]", "4", '{"lang": 4}'])
def test_a_damaged_one_is_named(tmp_path, meta):
    path = write(tmp_path / "demos.h5", [meta])
    with refused("demos.h5, demo_0, ep_meta"):
        read_instructions(path)


def test_older_files_have_none(tmp_path):
    with h5py.File(write(tmp_path / "demos.h5", [None])) as file:
        assert read_instruction(Node("demo_0", file["data/demo_0"])) is None


def test_no_file(tmp_path):
    with refused("demos.h5", FileNotFoundError):
        read_instructions(tmp_path / "demos.h5")
