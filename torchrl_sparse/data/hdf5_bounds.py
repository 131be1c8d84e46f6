"""Memory limits for reading demonstration files, derived from the size of the file.

HDF5 keeps nothing of a part that was never written, compresses others a thousandfold, follows links into other files and
repeats a text as often as it is mentioned: a file of a few kilobytes can describe more than any memory holds.
"""

from __future__ import annotations

import math
import zlib

import h5py

from torchrl_sparse.data.hdf5_nodes import Layout, Node
from torchrl_sparse.errors import InputError

__all__ = ["ARRAYS", "IMAGES", "Room", "most_demos"]

ARRAYS, IMAGES = 64 << 20, 256 << 20
"""Bytes of arrays, and of images, that may be read of a small file."""

_SMALL_FILE = 10_000_000
_UNFOLDED = 1000  # no compression of HDF5's makes much more of a byte
_DEMO = 2048  # bytes that the shortest demonstration takes with all its groups and datasets
_CHUNK = 512  # what looking for a chunk costs, as bytes that could be read meanwhile
_LARGE_CHUNK = 400_000
_HARMLESS = {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}


class Room:
    """Budget of bytes that may be read from a file; refuses whatever exceeds it.

    Args:
        size: of the file, bytes.
        small: bytes that may be read if it is smaller than 10 MB; of a larger file, a thousand times its size.

    Examples:
        >>> with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        ...     _ = file.create_dataset("actions", (10**7, 7), chunks=(1000, 7))
        ...     demo = Node("demo_0", file)
        ...     Room(demo.file_size(), ARRAYS).enter(demo.find("actions"))
        Traceback (most recent call last):
        ...
        torchrl_sparse.errors.InputError: demo_0, actions: expected at most 67108864 bytes of a file of this size, got 565120000
    """

    def __init__(self, size: int, small: int) -> None:
        self._is_small = size < _SMALL_FILE
        self._left = small if self._is_small else _UNFOLDED * size

    def enter(self, array: Node, itemsize: int = 8) -> Layout:
        """Charge an array at ``itemsize`` bytes per number to the budget and return its storage layout.

        Raises:
            InputError: if there is no room for it, or it is not kept as numbers in the file itself.
        """
        layout = array.layout()
        if layout.is_elsewhere or layout.shape is None or layout.dtype.kind not in "fiub":
            raise InputError(
                f"{array.where}: expected numbers in the file itself, got {layout.dtype} or a link"
            )
        cost = _cost(layout.shape, layout.chunks, max(itemsize, layout.dtype.itemsize))
        if cost > self._left:
            raise InputError(
                f"{array.where}: expected at most {self._left} bytes of a file of this size, got {cost}"
            )
        self._left -= cost
        if self._is_small and layout.chunks:
            _check_chunks(array, math.prod(layout.chunks) * layout.dtype.itemsize)
        return layout


def most_demos(size: int) -> int:
    """Return how many demonstrations a file of ``size`` bytes can hold; a few more for files that are almost empty."""
    return 64 + size // _DEMO


def _cost(shape: tuple[int, ...], chunks: tuple[int, ...] | None, itemsize: int) -> int:
    if not chunks:
        return math.prod(shape) * itemsize
    number = math.prod(-(-size // chunk) for size, chunk in zip(shape, chunks, strict=True))
    return max(math.prod(shape), math.prod(chunks)) * itemsize + number * _CHUNK


def _check_chunks(array: Node, whole: int) -> None:
    """Refuse chunks that unfold into more than they hold, ``whole`` bytes: HDF5 would make room for all of it."""
    compressions = [number for number in array.filters() if number not in _HARMLESS]
    if len(compressions) > 1:
        raise InputError(f"{array.where}: expected one compression at most, got {len(compressions)}")
    if compressions != [h5py.h5z.FILTER_DEFLATE]:
        return
    for offset in array.chunks_above(_LARGE_CHUNK):
        try:
            unfolded = zlib.decompressobj().decompress(array.stored_chunk(offset), whole + _CHUNK)
        except zlib.error as error:
            raise InputError(f"{array.where}: cannot be read: {error}") from error
        if len(unfolded) > whole:
            raise InputError(
                f"{array.where}: expected chunks of {whole} bytes, got one that unfolds into more"
            )
