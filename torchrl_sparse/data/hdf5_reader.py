"""Opening demonstration files in robomimic's HDF5 layout: names, filter keys, arrays, and errors that say where."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

__all__ = ["demo_names", "naming", "open_demos", "read_array"]

_DAMAGE = (OSError, KeyError, RuntimeError)  # h5py reports damaged files through all three


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
        raise FileNotFoundError(f"demonstrations: no file {path}")
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
    if "data" not in file or not isinstance(file["data"], h5py.Group):
        raise ValueError(f"{path}: expected a group 'data', got {sorted(file)}")
    with naming(f"{path}, data"):
        names = [name for name in file["data"] if name.startswith("demo_") and name[5:].isdigit()]
    if not names:
        raise ValueError(f"{path}: expected groups data/demo_<number>, got {sorted(file['data'])}")
    if filter_key is not None:
        names = _filtered(path, file, filter_key, names)
    return sorted(names, key=lambda name: int(name[5:]))


def read_array(where: str, demo: h5py.Group, name: str, length: int) -> np.ndarray:
    """Return one array f64 [length, n] of a demonstration, all of its numbers finite.

    Raises:
        ValueError: beginning with ``where``, if it is missing, damaged or of another shape.
    """
    with naming(where):
        if name not in demo:
            raise ValueError(f"{where}: expected a dataset {name!r}, got {_dataset_names(demo)}")
        value = np.asarray(demo[name], dtype=np.float64)
    if value.ndim != 2 or len(value) != length or not length:
        raise ValueError(
            f"{where}, {name}: expected shape [{length} = num_samples > 0, n], got {list(value.shape)}"
        )
    if not np.isfinite(value).all():
        raise ValueError(f"{where}, {name}: expected finite numbers, got {value[~np.isfinite(value)][0]}")
    return value


def _filtered(path: str | Path, file: h5py.File, filter_key: str, names: list[str]) -> list[str]:
    masks = file.get("mask", {})
    if filter_key not in masks:
        there = ", ".join(sorted(masks)) or "none"
        raise ValueError(f"{path}: expected a filter key mask/{filter_key}, got {there}")
    listed = list(masks[filter_key].asstr()[()])
    if missing := sorted(set(listed) - set(names)):
        raise ValueError(f"{path}, mask/{filter_key}: expected demonstrations of the file, got {missing[0]}")
    if not listed:
        raise ValueError(f"{path}, mask/{filter_key}: expected at least one demonstration, got none")
    return listed


def _dataset_names(demo: h5py.Group) -> list[str]:
    names: list[str] = []
    demo.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(names)


def _first_loss(path: Path) -> str:
    """Describe where a truncated file breaks off."""
    try:
        with open(path, "rb") as raw, h5py.File(_Endless(raw), "r") as file:
            for name in demo_names(path, file):
                try:
                    file["data"][name].visititems(_read_through)
                except _DAMAGE:
                    return f"{name} is the first demonstration that is damaged"
    except (ValueError, *_DAMAGE):
        pass
    return "its index of demonstrations is lost"


def _read_through(name: str, item: h5py.Group | h5py.Dataset) -> None:
    if isinstance(item, h5py.Dataset):
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
