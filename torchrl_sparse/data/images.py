"""Camera images of demonstration files, read one demonstration at a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import torch
from tensordict import MemoryMappedTensor
from torch import Tensor

__all__ = ["read_images"]


def read_images(
    path: Path, data: h5py.Group, lengths: Mapping[str, int], key: str, folder: str | Path | None
) -> Tensor:
    """Images u8 [N, 3, h, w] of all demonstrations, one demonstration in memory at a time.

    Args:
        path: the file, for messages.
        data: its group of demonstrations, which hold images as u8 [T, h, w, 3].
        lengths: demonstration -> its number of steps, in order.
        key: the observation to read.
        folder: where to put a memory-mapped file; None keeps the images in memory.

    Raises:
        ValueError: naming file, demonstration and observation, if images are missing, damaged or of another
            size than those before.
    """
    images, first = None, 0
    for name, length in lengths.items():
        episode = _read_episode(f"{path}, {name}, obs/{key}", data[name], key, length)
        if images is None:
            images = _allocate((sum(lengths.values()), *episode.shape[1:]), folder, key)
        if episode.shape[1:] != images.shape[1:]:
            raise ValueError(
                f"{path}, {name}, obs/{key}: expected images {list(images.shape[1:])} as before, "
                f"got {list(episode.shape[1:])}"
            )
        images[first : first + length] = torch.from_numpy(episode)
        first += length
    return images


def _read_episode(where: str, demo: h5py.Group, key: str, length: int) -> np.ndarray:
    """u8 [T, 3, h, w]."""
    try:
        images = np.asarray(demo[f"obs/{key}"])
    except (OSError, KeyError, RuntimeError) as error:  # h5py reports damaged files through all three
        raise ValueError(f"{where}: cannot be read: {error}") from error
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[-1] != 3 or len(images) != length:
        raise ValueError(
            f"{where}: expected uint8 [{length}, h, w, 3], got {images.dtype} {list(images.shape)}"
        )
    return np.ascontiguousarray(images.transpose(0, 3, 1, 2))


def _allocate(shape: tuple[int, ...], folder: str | Path | None, key: str) -> Tensor:
    if folder is None:
        return torch.empty(shape, dtype=torch.uint8)
    Path(folder).mkdir(parents=True, exist_ok=True)
    # What an earlier run left is written anew: it may be of other demonstrations, or half of them.
    filename = str(Path(folder) / f"{key}.memmap")
    return MemoryMappedTensor.empty(shape, dtype=torch.uint8, filename=filename, existsok=True)
