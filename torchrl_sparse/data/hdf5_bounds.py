"""Bound what a demonstration file may ask for: what it holds itself, and little if it is small.

HDF5 keeps nothing of a part that was never written, compresses others a thousandfold, follows links into other files and
repeats a text as often as it is mentioned: a file of a few kilobytes can describe more than any memory holds.
"""

from __future__ import annotations

import math
import zlib

import h5py
import numpy as np

__all__ = ["ARRAYS", "IMAGES", "Room", "count_attribute", "member", "most_demos", "text_attribute"]

ARRAYS, IMAGES = 64 << 20, 256 << 20
"""Bytes of arrays, and of images, that may be read of a small file."""

_SMALL_FILE = 10_000_000
_UNFOLDED = 1000  # no compression of HDF5's makes much more of a byte
_DEMO = 2048  # bytes that the shortest demonstration takes with all its groups and datasets
_CHUNK = 512  # what looking for a chunk costs, as bytes that could be read meanwhile
_LARGE_CHUNK = 400_000
_HARMLESS = {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}


class Room:
    """Counts what is read of a file, and refuses what would be too much.

    Args:
        size: of the file, bytes.
        small: bytes that may be read if it is smaller than 10 MB; of a larger file, a thousand times its size.

    Examples:
        >>> with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        ...     _ = file.create_dataset("actions", (10**9, 7), chunks=(1000, 7))
        ...     Room(file.id.get_filesize(), ARRAYS).enter("demo_0", file["actions"])
        Traceback (most recent call last):
        ...
        ValueError: demo_0: expected at most 67108864 bytes of a file of this size, got 56512000000
    """

    def __init__(self, size: int, small: int) -> None:
        self._is_small = size < _SMALL_FILE
        self._left = small if self._is_small else _UNFOLDED * size

    def enter(self, where: str, dataset: h5py.Dataset, itemsize: int = 8) -> None:
        """Count ``dataset``, of whose numbers each will take ``itemsize`` bytes.

        Raises:
            ValueError: beginning with ``where``, if there is no room for it, or it is not kept as numbers in the file itself.
        """
        if (
            dataset.is_virtual
            or dataset.external
            or dataset.shape is None
            or dataset.dtype.kind not in "fiub"
        ):
            raise ValueError(f"{where}: expected numbers in the file itself, got {dataset.dtype} or a link")
        cost = _cost(dataset, max(itemsize, dataset.dtype.itemsize))
        if cost > self._left:
            raise ValueError(
                f"{where}: expected at most {self._left} bytes of a file of this size, got {cost}"
            )
        self._left -= cost
        if self._is_small and dataset.chunks:
            _check_chunks(where, dataset)


def most_demos(size: int) -> int:
    """Return how many demonstrations a file of ``size`` bytes can hold; a few more for files that are all but empty."""
    return 64 + size // _DEMO


def member(where: str, group: h5py.Group, path: str) -> h5py.Group | h5py.Dataset | None:
    """Return the group or dataset at ``path`` of ``group``; None if there is none.

    Raises:
        ValueError: beginning with ``where``, if it is a link to elsewhere.
    """
    for part in path.split("/"):
        if not isinstance(group, h5py.Group) or not group.id.links.exists(part.encode()):
            return None
        if group.id.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise ValueError(f"{where}: expected {path!r} in the file itself, got a link to elsewhere")
        group = group[part]
    return group


def count_attribute(where: str, item: h5py.Group, name: str) -> int:
    """Return the attribute ``name``, a whole number.

    Raises:
        ValueError: beginning with ``where``, if it is missing or anything else.
    """
    if name not in item.attrs:
        raise ValueError(f"{where}: expected an attribute {name!r}, got {sorted(item.attrs)[:5]}")
    attribute = item.attrs.get_id(name)
    if attribute.shape != () or attribute.dtype.kind not in "iu":
        raise ValueError(f"{where}, {name}: expected a whole number, got {attribute.dtype} {attribute.shape}")
    return int(item.attrs[name])


def text_attribute(where: str, item: h5py.Group, name: str) -> str | None:
    """Return the attribute ``name``, a text; None if there is none.

    Raises:
        ValueError: beginning with ``where``, if it is anything else.
    """
    if name not in item.attrs:
        return None
    attribute = item.attrs.get_id(name)
    if attribute.shape != () or h5py.check_string_dtype(attribute.dtype) is None:
        raise ValueError(f"{where}, {name}: expected a text, got {attribute.dtype} {attribute.shape}")
    text = item.attrs[name]
    return text.decode(errors="replace") if isinstance(text, (bytes, np.bytes_)) else str(text)


def _cost(dataset: h5py.Dataset, itemsize: int) -> int:
    if not dataset.chunks:
        return dataset.size * itemsize
    axes = zip(dataset.shape, dataset.chunks, strict=True)
    chunks = math.prod(-(-size // chunk) for size, chunk in axes)
    return max(dataset.size, math.prod(dataset.chunks)) * itemsize + chunks * _CHUNK


def _check_chunks(where: str, dataset: h5py.Dataset) -> None:
    """Refuse chunks that unfold into more than they hold: HDF5 would make room for all of it."""
    settings = dataset.id.get_create_plist()
    filters = [settings.get_filter(index)[0] for index in range(settings.get_nfilters())]
    compressions = [number for number in filters if number not in _HARMLESS]
    if len(compressions) > 1:
        raise ValueError(f"{where}: expected one compression at most, got {len(compressions)}")
    if compressions != [h5py.h5z.FILTER_DEFLATE]:
        return
    large: list[tuple[int, ...]] = []
    dataset.id.chunk_iter(
        lambda chunk: large.append(chunk.chunk_offset) if chunk.size > _LARGE_CHUNK else None
    )
    whole = math.prod(dataset.chunks) * dataset.dtype.itemsize
    for offset in large:
        _, stored = dataset.id.read_direct_chunk(offset)
        try:
            unfolded = zlib.decompressobj().decompress(stored, whole + _CHUNK)
        except zlib.error as error:
            raise ValueError(f"{where}: cannot be read: {error}") from error
        if len(unfolded) > whole:
            raise ValueError(f"{where}: expected chunks of {whole} bytes, got one that unfolds into more")
