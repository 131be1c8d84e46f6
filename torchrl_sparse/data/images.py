"""Camera images of demonstration files, read one demonstration at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path

import h5py
import numpy as np
import torch
from tensordict import MemoryMappedTensor
from torch import Tensor

from torchrl_sparse.data.hdf5_bounds import IMAGES
from torchrl_sparse.data.hdf5_reader import ArrayReader
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["chosen_cameras", "read_images"]


def chosen_cameras(cameras: Mapping[str, str | None]) -> dict[str, str]:
    """Name of an image here -> its name in the demonstrations, of those that have one.

    >>> chosen_cameras({"image": "agentview_image", "wrist_image": None})
    {'image': 'agentview_image'}
    """
    return {name: key for name, key in cameras.items() if key is not None}


def read_images(
    path: str | Path, data: h5py.Group, lengths: Mapping[str, int], key: str, folder: str | Path | None
) -> Tensor:
    """Read images u8 [N, 3, h, w] of all demonstrations, one demonstration in memory at a time.

    Args:
        path: the file, for messages.
        data: its group of demonstrations, which hold images as u8 [T, h, w, 3].
        lengths: demonstration -> its number of steps, in order.
        key: the observation to read.
        folder: where to put a memory-mapped file, which appears when it is complete; None keeps the images in memory.

    Raises:
        ValueError: naming file, demonstration and observation, if images are missing, damaged or of another
            size than those before.
    """
    episodes = _episodes(path, data, lengths, key)
    episodes = chain([next(episodes)], episodes)  # what is missing is found before anything is written
    if folder is None:
        return torch.cat([torch.from_numpy(episode) for episode in episodes])
    filename = Path(folder) / f"{key}.memmap"
    # Written as a file, not through the map: the pages of a map that were touched count as this process's memory.
    with atomic_path(filename) as temporary, open(temporary, "wb") as file:
        for episode in episodes:
            file.write(episode)
            frame = episode.shape[1:]
    shape = (sum(lengths.values()), *frame)
    return MemoryMappedTensor.from_filename(filename, dtype=torch.uint8, shape=shape)


def _episodes(
    path: str | Path, data: h5py.Group, lengths: Mapping[str, int], key: str
) -> Iterator[np.ndarray]:
    """Return u8 [T, 3, h, w] of each demonstration, all of one height and width."""
    frame: tuple[int, ...] | None = None
    reader = ArrayReader(data.file, IMAGES)
    for name, length in lengths.items():
        where = f"{path}, {name}, obs/{key}"
        episode = reader.images(where, data[name], f"obs/{key}", length).transpose(0, 3, 1, 2)
        frame = frame or episode.shape[1:]
        if episode.shape[1:] != frame:
            raise ValueError(
                f"{where}: expected images {list(frame)} as before, got {list(episode.shape[1:])}"
            )
        yield np.ascontiguousarray(episode)
