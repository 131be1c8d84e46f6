"""Filter keys, and what is said of files that are damaged or cut off."""

import h5py
import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.data.hdf5_reader import demo_names, open_demos
from torchrl_sparse.data.hdf5_writer import lay_out

DEMOS = [f"demo_{number}" for number in range(12)]


def fill(group, number):
    rng = np.random.default_rng(number)
    group.attrs["num_samples"] = 20
    group["actions"] = rng.standard_normal((20, 7))
    group.create_dataset("obs/image", data=rng.integers(0, 256, (20, 8, 8, 3)), compression="gzip")


@pytest.fixture
def path(tmp_path):
    """As this library writes: the index of demonstrations comes first."""
    with h5py.File(tmp_path / "demos.h5", "w") as file:
        data = lay_out(file, DEMOS, {"total": 240, "env_args": {"env_name": "Lift"}})
        for number, name in enumerate(DEMOS):
            fill(data[name], number)
        file["mask/train"] = np.array(["demo_10", "demo_2"], dtype="S8")
        file["mask/gone"] = np.array(["demo_2", "demo_99"], dtype="S8")
        file["mask/empty"] = np.array([], dtype="S8")
    return tmp_path / "demos.h5"


def end_of(path, name):
    """Position after the last byte of a demonstration's arrays."""
    with h5py.File(path) as file:
        image, actions = file[f"data/{name}/obs/image"], file[f"data/{name}/actions"]
        chunks = [image.id.get_chunk_info(i) for i in range(image.id.get_num_chunks())]
        ends = [chunk.byte_offset + chunk.size for chunk in chunks]
        return max(*ends, actions.id.get_offset() + actions.id.get_storage_size())


@pytest.mark.parametrize("number", [0, 5, 10])
def test_a_truncated_file_names_the_first_demonstration_that_is_damaged(path, number):
    end = end_of(path, DEMOS[number])
    path.write_bytes(path.read_bytes()[: end - 1])
    message = rf"demos\.h5: expected a complete HDF5 file.*; {DEMOS[number]} is the first demonstration that is damaged"
    with pytest.raises(ValueError, match=message), open_demos(path):
        pass


def test_of_an_index_at_the_end_nothing_is_left(tmp_path):
    path = tmp_path / "demos.h5"
    with h5py.File(path, "w") as file:
        for number, name in enumerate(DEMOS):
            fill(file.create_group(f"data/{name}"), number)
        file["data"].attrs["env_args"] = "as published, written last" * 100
    path.write_bytes(path.read_bytes()[: end_of(path, "demo_5")])
    with refused("demos.h5"), open_demos(path):
        pass


@pytest.mark.parametrize("text", [b"", b"not HDF5 at all"])
def test_what_is_no_hdf5_file(path, text):
    path.write_bytes(text)
    with refused("demos.h5"), open_demos(path):
        pass


def test_filter_keys(path):
    with open_demos(path) as file:
        assert demo_names(file) == DEMOS
        assert demo_names(file, "train") == ["demo_2", "demo_10"]
        for key, message in (
            ("valid", "demos.h5"),
            ("gone", "demos.h5, mask/gone"),
            ("empty", "demos.h5, mask/empty"),
        ):
            with refused(message):
                demo_names(file, key)
