"""A full disk is called by its name, whoever writes."""

import errno
import subprocess

import h5py
import numpy as np
import pytest
import torch

from torchrl_sparse.evaluation.rollouts.episodes import EpisodeLog, EpisodeResult
from torchrl_sparse.runtime.disk import naming_full_disk
from torchrl_sparse.storage.atomic import atomic_path


@pytest.fixture
def small(tmp_path):
    """A volume of half a megabyte."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("may not mount")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def write_bytes(path):
    path.write_bytes(bytes(1 << 20))


def write_checkpoint(path):
    torch.save({"weights": torch.zeros(1 << 18)}, path)


def write_demos(path):
    with h5py.File(path, "w") as file:
        file["data"] = np.zeros(1 << 20, dtype=np.uint8)


@pytest.mark.parametrize("write", [write_bytes, write_checkpoint, write_demos])
def test_a_full_volume_is_named_and_nothing_left_on_it(small, write):
    told = rf"no space left on the volume {small}: '{small}/file.bin'"
    with pytest.raises(OSError, match=told), atomic_path(small / "file.bin") as temporary:
        write(temporary)
    assert list(small.iterdir()) == []


def test_an_episode_that_finds_no_room_names_its_log(small):
    log = EpisodeLog(small / "dense.jsonl")
    (small / "filler").write_bytes(bytes(504 << 10))
    episode = EpisodeResult(7, True, 30, 4, 6.3e10, 0.0, latency=(0.123456789,) * 2000)
    with pytest.raises(OSError, match=rf"no space left on the volume {small}: '{log.path}'"):
        log.append(episode)


def test_a_quota_is_none(tmp_path):
    with (
        pytest.raises(OSError, match="quota exceeded on the volume /"),
        naming_full_disk(tmp_path / "new" / "file"),
    ):
        raise OSError(errno.EDQUOT, "Disk quota exceeded")


def test_other_errors_stay_as_they_are(tmp_path):
    with pytest.raises(KeyError), naming_full_disk(tmp_path):
        raise KeyError("other")
