"""Small demonstration files that ask for much: each is read or refused within the limits of `tests.limits`."""

import json
import os
import zlib

import h5py
import numpy as np
import pytest

from tests.data.big_files import write_big
from tests.fixtures.demonstrations import describe
from tests.limits import check_limits
from torchrl_sparse.data.instructions import read_instructions
from torchrl_sparse.data.robomimic import read_demos

CAMERAS = {"image": "agentview_image"}
STEPS = 20


def read(path):
    read_demos(path, ["state"], cameras=CAMERAS)


def read_big(path):
    read_demos(path, ["robot0_eef_pos"], cameras=CAMERAS)


def read_chosen(path):
    read_demos(path, ["state"], filter_key="train")


def fill(demo, steps=STEPS):
    rng = np.random.default_rng(0)
    demo.attrs["num_samples"] = steps
    demo["actions"] = rng.uniform(-1, 1, (steps, 7))
    demo["obs/state"] = rng.uniform(-1, 1, (steps, 3))
    demo["obs/agentview_image"] = rng.integers(0, 255, (steps, 8, 8, 3), np.uint8)


@pytest.fixture
def path(tmp_path):
    with h5py.File(tmp_path / "small.h5", "w") as file:
        for index in range(3):
            fill(file.create_group(f"data/demo_{index}"))
        describe(file)
    return tmp_path / "small.h5"


def refusal(path, change, read=read):
    with h5py.File(path, "r+") as file:
        change(file)
    return check_limits(read, path)


def dataset(name, *args, steps=STEPS, **options):
    """A change of a file: another dataset for demo_1."""

    def change(file):
        del file[f"data/demo_1/{name}"]
        file["data/demo_1"].create_dataset(name, *args, **options)
        file["data/demo_1"].attrs["num_samples"] = steps

    return change


def test_an_honest_file_is_read(path):
    assert check_limits(read, path) is None


def test_pictures_that_compress_well_are_read(tmp_path):
    path = write_big(tmp_path / "images.hdf5", demos=12, length=1000)
    assert path.stat().st_size < 5_000_000
    assert check_limits(read_big, path) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dataset("actions", (10**9, 7), chunks=(1000, 7), steps=10**9), "demo_1, actions: expected at most"),
        (dataset("actions", (10**6, 7), chunks=(1, 1), steps=10**6), "demo_1, actions: expected at most"),
        (dataset("actions", (STEPS, 10**8), chunks=(1, 1000)), "demo_1, actions: expected at most"),
        (dataset("actions", (STEPS, 7), maxshape=(None, None), chunks=(10**4, 10**4)), "demo_1, actions: expected at most"),
        (dataset("actions", (STEPS, 7), dtype="S1000000"), "demo_1, actions: expected numbers in the file itself"),
        (dataset("actions", (STEPS, 7), dtype=h5py.string_dtype()), "demo_1, actions: expected numbers in the file"),
        (dataset("actions", data=h5py.Empty("f")), "demo_1, actions: expected numbers in the file itself"),
        (dataset("obs/state", (10**8, 3), chunks=(1000, 3), compression="gzip"), "demo_1, obs/state: expected at most"),
        (dataset("obs/agentview_image", (STEPS, 10**4, 10**4, 3), np.uint8, chunks=(1, 100, 100, 3)),
         "obs/agentview_image: expected at most"),
        (dataset("obs/agentview_image", (STEPS, 8, 8, 3), np.float64, maxshape=(None,) * 4, chunks=(1, 8, 8, 10**7)),
         "obs/agentview_image: expected at most"),
    ],
)  # fmt: skip
def test_arrays_larger_than_the_file(path, change, message):
    assert message in refusal(path, change)


def test_a_chunk_that_unfolds_into_more(path):
    squeeze = zlib.compressobj(9)
    bomb = b"".join(squeeze.compress(bytes(10**7)) for _ in range(120)) + squeeze.flush()

    def change(file):
        dataset("actions", (STEPS, 7), chunks=(STEPS, 7), compression="gzip")(file)
        file["data/demo_1/actions"].id.write_direct_chunk((0, 0), bomb)

    assert "demo_1, actions: expected chunks of 560 bytes" in refusal(path, change)


def test_demonstrations_that_are_one_and_the_same(path):
    def change(file):
        large = file["data/demo_0"]
        del large["obs/state"]
        large["obs"].create_dataset("state", data=np.zeros((50_000, 3)), compression="gzip")
        del large["actions"]
        large.create_dataset("actions", data=np.zeros((50_000, 7)), compression="gzip")
        large.attrs["num_samples"] = 50_000
        for index in range(3, 60):
            file[f"data/demo_{index}"] = large

    assert "bytes of a file of this size" in refusal(path, change)


def test_a_demonstration_linked_twenty_thousand_times(path):
    def change(file):
        for index in range(3, 20_000):
            file[f"data/demo_{index}"] = file["data/demo_0"]

    assert "demonstrations in a file of its size, got 20000" in refusal(path, change)


def test_as_many_demonstrations_as_there_may_be(tmp_path):
    path = tmp_path / "small.h5"
    with h5py.File(path, "w", libver="latest") as file:
        for index in range(2500):
            fill(file.create_group(f"data/demo_{index}"), steps=4)
        describe(file)
    assert check_limits(read, path) is None


@pytest.mark.parametrize("name", ["data", "data/demo_1", "data/demo_1/obs", "data/demo_1/actions", "mask"])
def test_links_to_a_file_that_never_answers(path, tmp_path, name):
    os.mkfifo(tmp_path / "fifo")

    def change(file):
        if name in file:
            del file[name]
        file[name] = h5py.ExternalLink(str(tmp_path / "fifo"), "/")

    assert "in the file itself, got a link" in refusal(path, change, read_chosen if name == "mask" else read)


def test_arrays_kept_in_another_file(path, tmp_path):
    (tmp_path / "secret").write_bytes(bytes(1000))
    elsewhere = dataset("actions", (STEPS, 7), external=[(str(tmp_path / "secret"), 0, 1000)])
    assert "demo_1, actions: expected numbers in the file itself" in refusal(path, elsewhere)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(8000), "num_samples: expected a whole number, got float64 (8000,)"),
        ("seven", "num_samples: expected a whole number"),
        (2**62, "expected shape [4611686018427387904 = num_samples"),
        (-1, "expected shape [-1 = num_samples"),
    ],
)
def test_numbers_of_steps(path, value, message):
    assert message in refusal(path, lambda file: file["data/demo_1"].attrs.__setitem__("num_samples", value))


def test_texts_that_mention_one_long_text_again_and_again(path):
    words = np.array(["a" * 3_000_000] * 2, object)

    def change(file):
        file.create_dataset("mask/train", data=words, dtype=h5py.string_dtype())

    assert "mask/train: expected demonstrations of the file, got aaaa" in refusal(path, change, read_chosen)


def test_more_names_than_demonstrations(path):
    def change(file):
        file.create_dataset("mask/train", (10**9,), "S8", chunks=(1000,))

    assert "mask/train: expected names of demonstrations, got |S8 [1000000000]" in refusal(
        path, change, read_chosen
    )


@pytest.mark.parametrize("text", ["[" * 5_000_000, json.dumps({"lang": "x" * 5_000_000})])
def test_long_and_deep_texts(path, text):
    def change(file):
        file["data/demo_0"].attrs.create("ep_meta", text, dtype=h5py.string_dtype())

    assert "small.h5, demo_" in refusal(path, change, read_instructions)


def test_a_truncated_file_of_endless_arrays(path):
    with h5py.File(path, "r+") as file:
        dataset("actions", (10**9, 7), chunks=(1, 7))(file)
        file["end"] = np.zeros(10_000)
    path.write_bytes(path.read_bytes()[:-1000])
    assert "demo_1 is the first demonstration that is damaged" in check_limits(read, path)
