"""Opening demonstration files in robomimic's HDF5 layout: names, filter keys, arrays, and errors that say where."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from torchrl_sparse.data.hdf5_bounds import ARRAYS, IMAGES, Room, count_attribute, member, most_demos

__all__ = ["ArrayReader", "demo_group", "demo_names", "each_path", "naming", "open_demo", "open_demos"]

_DAMAGE = (OSError, KeyError, RuntimeError, TypeError)  # h5py reports damaged files through all of them
_NAME = re.compile(r"demo_[0-9]{1,9}")


@contextmanager
def open_demos(path: str | Path) -> Iterator[h5py.File]:
    """Open a demonstration file for reading.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is no complete HDF5 file; of a truncated one the message names the first demonstration that is
            damaged, unless the index of demonstrations is lost with it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a file of demonstrations, got none")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(
            f"{path}: expected a complete HDF5 file, got one that h5py cannot open ({error}); {_first_loss(path)}"
        ) from error
    with file:
        yield file


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Turn what h5py raises on damaged files into a ValueError that begins with ``where``."""
    try:
        yield
    except _DAMAGE as error:
        raise ValueError(f"{where}: cannot be read: {error}") from error


def each_path(paths: str | Path | Sequence[str | Path]) -> list[str | Path]:
    """Return one path, or several, as a list.

    >>> each_path("data/lift.h5"), each_path(["a.h5", "b.h5"])
    (['data/lift.h5'], ['a.h5', 'b.h5'])
    """
    return [paths] if isinstance(paths, str | Path) else list(paths)


def demo_names(path: str | Path, file: h5py.File, filter_key: str | None = None) -> list[str]:
    """Return the names of the demonstrations of an open file, in the order of their numbers.

    Args:
        path: the file, for messages.
        file: the same, open.
        filter_key: only those that the file lists as ``mask/<filter_key>``, e.g. "train" or "better".

    Raises:
        ValueError: if there are none, or no such filter key, or it lists a demonstration that is not there.

    Examples:
        >>> with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        ...     _ = file.create_group("data/demo_10"), file.create_group("data/demo_9")
        ...     demo_names("in memory", file)
        ['demo_9', 'demo_10']
    """
    data = demo_group(path, file)
    with naming(f"{path}, data"):
        names = [name for name in data if _NAME.fullmatch(name)]
    if not names:
        raise ValueError(f"{path}: expected groups data/demo_<number>, got {sorted(data)[:5]}")
    most = most_demos(file.id.get_filesize())
    if len(names) > most:
        raise ValueError(
            f"{path}: expected at most {most} demonstrations in a file of its size, got {len(names)}"
        )
    if filter_key is not None:
        names = _filtered(path, file, filter_key, names)
    return sorted(names, key=lambda name: int(name[5:]))


def demo_group(path: str | Path, file: h5py.File) -> h5py.Group:
    """Return the group of an open file's demonstrations.

    Raises:
        ValueError: naming ``path``, if there is none.
    """
    data = member(str(path), file, "data")
    if not isinstance(data, h5py.Group):
        raise ValueError(f"{path}: expected a group 'data', got {sorted(file)[:5]}")
    return data


def open_demo(where: str, data: h5py.Group, name: str) -> tuple[h5py.Group, int]:
    """Return the demonstration ``name`` and its number of steps, the attribute ``num_samples``.

    Raises:
        ValueError: beginning with ``where``, if the demonstration is damaged or elsewhere, or does not tell.
    """
    with naming(where):
        demo = member(where, data, name)
        if not isinstance(demo, h5py.Group):
            raise ValueError(f"{where}: expected a group, got another kind of entry")
        return demo, count_attribute(where, demo, "num_samples")


class ArrayReader:
    """Reads arrays of an open file, together no more than its size bears out.

    Args:
        file: the file.
        small: bytes that may be read if the file is small, see `Room`.
    """

    def __init__(self, file: h5py.File, small: int = ARRAYS) -> None:
        self._room = Room(file.id.get_filesize(), small)

    def numbers(self, where: str, demo: h5py.Group, name: str, length: int) -> np.ndarray:
        """Return one array f64 [length, n] of a demonstration, all of its numbers finite.

        Raises:
            ValueError: beginning with ``where``, if it is missing, damaged, too large or of another shape.
        """
        dataset = self._enter(where, demo, name, np.dtype(np.float64).itemsize)
        if dataset.ndim != 2 or len(dataset) != length or not length:
            raise ValueError(
                f"{where}, {name}: expected shape [{length} = num_samples > 0, n], got {list(dataset.shape)}"
            )
        with naming(where):
            value = np.asarray(dataset, dtype=np.float64)
        if not np.isfinite(value).all():
            raise ValueError(f"{where}, {name}: expected finite numbers, got {value[~np.isfinite(value)][0]}")
        return value

    def images(self, where: str, demo: h5py.Group, name: str, length: int) -> np.ndarray:
        """Return images u8 [length, h, w, 3] of a demonstration.

        Raises:
            ValueError: beginning with ``where``, if they are missing, damaged, too many or of another shape or type.
        """
        dataset = self._enter(where, demo, name, 1)
        shape = dataset.shape
        if dataset.dtype != np.uint8 or len(shape) != 4 or (shape[0], shape[3]) != (length, 3):
            raise ValueError(
                f"{where}: expected uint8 [{length}, h, w, 3], got {dataset.dtype} {list(shape)}"
            )
        with naming(where):
            return np.asarray(dataset)

    def _enter(self, where: str, demo: h5py.Group, name: str, itemsize: int) -> h5py.Dataset:
        with naming(where):
            dataset = member(where, demo, name)
            if not isinstance(dataset, h5py.Dataset):
                raise ValueError(f"{where}: expected a dataset {name!r}, got {_dataset_names(demo)[:20]}")
            self._room.enter(f"{where}, {name}", dataset, itemsize)
        return dataset


def _filtered(path: str | Path, file: h5py.File, filter_key: str, names: list[str]) -> list[str]:
    where = f"{path}, mask/{filter_key}"
    with naming(where):
        masks, mask = member(where, file, "mask"), member(where, file, f"mask/{filter_key}")
    if not isinstance(mask, h5py.Dataset):
        there = ", ".join(sorted(masks)[:20]) if isinstance(masks, h5py.Group) else ""
        raise ValueError(f"{path}: expected a filter key mask/{filter_key}, got {there or 'none'}")
    if mask.ndim != 1 or h5py.check_string_dtype(mask.dtype) is None or len(mask) > len(names):
        raise ValueError(f"{where}: expected names of demonstrations, got {mask.dtype} {list(mask.shape)}")
    known, listed = {*names}, []
    for index in range(len(mask)):  # one by one: each may be of any length
        with naming(where):
            listed.append(mask.asstr()[index])
        if listed[-1] not in known:
            raise ValueError(f"{where}: expected demonstrations of the file, got {listed[-1][:80]}")
    if not listed:
        raise ValueError(f"{where}: expected at least one demonstration, got none")
    return listed


def _dataset_names(demo: h5py.Group) -> list[str]:
    names: list[str] = []
    demo.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(names)


def _first_loss(path: Path) -> str:
    """Describe where a truncated file breaks off."""
    room = Room(path.stat().st_size, IMAGES)
    try:
        with open(path, "rb") as raw, h5py.File(_Endless(raw), "r") as file:
            for name in demo_names(path, file)[: most_demos(path.stat().st_size)]:
                try:
                    file["data"][name].visititems(partial(_read_through, room))
                except (ValueError, *_DAMAGE):
                    return f"{name} is the first demonstration that is damaged"
    except (ValueError, *_DAMAGE):
        pass
    return "its index of demonstrations is lost"


def _read_through(room: Room, name: str, item: h5py.Group | h5py.Dataset) -> None:
    if isinstance(item, h5py.Dataset):
        room.enter(name, item, 1)
        for part in item.iter_chunks() if item.chunks else [()]:
            item[part]


class _Endless(io.RawIOBase):
    """A file that does not tell where it ends: HDF5 refuses to open one that is shorter than it should be, and so could not
    say what of it is whole."""

    def __init__(self, raw: io.BufferedReader):
        self._raw, self._at = raw, 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = 2**62 if whence == io.SEEK_END else offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer) -> int:
        self._raw.seek(self._at)
        read = self._raw.readinto(buffer)
        if read < len(buffer):
            raise OSError(f"the file ends at byte {self._at + read}")
        return read
