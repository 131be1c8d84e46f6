"""Camera images of demonstration files, read one demonstration at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from tensordict import MemoryMappedTensor
from torch import Tensor

from torchrl_sparse.data.hdf5_bounds import IMAGES
from torchrl_sparse.data.hdf5_reader import ArrayReader, demo_group, open_demos
from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["RecordedImages", "chosen_cameras", "read_images"]


def chosen_cameras(cameras: Mapping[str, str | None]) -> dict[str, str]:
    """Map the name of each image here to its name in the demonstrations, for images that have one.

    >>> chosen_cameras({"image": "agentview_image", "wrist_image": None})
    {'image': 'agentview_image'}
    """
    return {name: key for name, key in cameras.items() if key is not None}


@dataclass(frozen=True)
class RecordedImages:
    """Images of a file's demonstrations, ``obs/<key>`` u8 [T, h, w, 3] in each.

    Attributes:
        path: of the file.
        lengths: demonstration -> its number of steps, in the order in which they are read.
    """

    path: str | Path
    lengths: Mapping[str, int]

    def episodes(self, key: str) -> Iterator[tuple[str, np.ndarray]]:
        """Return for each demonstration its location, for messages, and one camera's images, u8 [T, 3, h, w]."""
        with open_demos(self.path) as file:
            data, reader = demo_group(file), ArrayReader(file, IMAGES)
            for name, length in self.lengths.items():
                images = reader.images(data.group(name), f"obs/{key}", length)
                yield f"{self.path}, {name}, obs/{key}", np.ascontiguousarray(images.transpose(0, 3, 1, 2))


def read_images(files: Sequence[RecordedImages], key: str, folder: str | Path | None) -> Tensor:
    """Read images u8 [N, 3, h, w] of all demonstrations of all files, holding one demonstration in memory at a time.

    Args:
        files: in this order.
        key: the observation to read.
        folder: where to put a memory-mapped file, which appears when it is complete; None keeps the images in memory.

    Raises:
        InputError: naming file, demonstration and observation, if images are missing, damaged or of another
            size than those before.
    """
    episodes = _of_one_size(chain.from_iterable(file.episodes(key) for file in files))
    episodes = chain([next(episodes)], episodes)  # what is missing is found before anything is written
    if folder is None:
        return torch.cat([torch.from_numpy(episode) for episode in episodes])
    filename = Path(folder) / f"{key}.memmap"
    # Written as a file, not through the map: the pages of a map that were touched count as this process's memory.
    with atomic_path(filename) as temporary, open(temporary, "wb") as written:
        for episode in episodes:
            written.write(episode.data)
            frame = episode.shape[1:]
    shape = (sum(sum(file.lengths.values()) for file in files), *frame)
    return MemoryMappedTensor.from_filename(filename, dtype=torch.uint8, shape=shape)


def _of_one_size(episodes: Iterator[tuple[str, np.ndarray]]) -> Iterator[np.ndarray]:
    """Pass on images u8 [T, 3, h, w], all of one height and width."""
    frame: tuple[int, ...] | None = None
    for where, episode in episodes:
        frame = frame or episode.shape[1:]
        if episode.shape[1:] != frame:
            raise InputError(
                f"{where}: expected images {list(frame)} as before, got {list(episode.shape[1:])}"
            )
        yield episode
