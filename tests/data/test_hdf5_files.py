"""An HDF5 file is whole or not there, and a full disk is one error, not one per object that HDF5 then cannot close."""

import gc
import io

import h5py
import numpy as np
import pytest

from torchrl_sparse.data import hdf5_files
from torchrl_sparse.data.hdf5_files import new_hdf5


def fill(file, groups=20):
    for index in range(groups):
        file[f"data/demo_{index}/actions"] = np.full((50, 7), index, dtype=np.float64)
        file[f"data/demo_{index}"].attrs["seed"] = index


def test_it_holds_what_was_written(tmp_path):
    for name in ("new.h5", "again.h5"):
        with new_hdf5(tmp_path / name) as file:
            fill(file)
            assert file["data/demo_3/actions"][0, 0] == 3
    with h5py.File(tmp_path / "new.h5") as file:
        assert len(file["data"]) == 20
        assert all(np.all(file[f"data/demo_{index}/actions"][:] == index) for index in range(20))
    assert (tmp_path / "new.h5").read_bytes() == (tmp_path / "again.h5").read_bytes()


class Full(io.FileIO):
    """A file on a disk that is full after some bytes."""

    room = 0

    def write(self, data):
        if self.tell() + len(data) > self.room:
            raise OSError(28, "No space left on device")
        return super().write(data)


@pytest.mark.parametrize("room", [0, 2000, 8000, 30000, 60000])
def test_a_full_disk_is_one_error_that_names_the_file(tmp_path, monkeypatch, capfd, room):
    monkeypatch.setattr(Full, "room", room)
    monkeypatch.setattr(hdf5_files, "open", lambda path, mode, buffering: Full(path, "w+"), raising=False)
    with (
        pytest.raises(OSError, match=r"no space left on the volume .*new\.h5"),
        new_hdf5(tmp_path / "new.h5") as file,
    ):
        fill(file)
    del file
    gc.collect()
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []


def break_off(path):
    with new_hdf5(path) as file:
        fill(file)
        raise KeyError("other")


def test_an_error_of_the_block_leaves_nothing(tmp_path):
    with pytest.raises(KeyError, match="other"):
        break_off(tmp_path / "new.h5")
    assert list(tmp_path.iterdir()) == []
