"""Reader of demonstration files in robomimic's HDF5 layout: names, filter keys, arrays, and errors that say where."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_sparse.data.hdf5_bounds import ARRAYS, IMAGES, Room, most_demos
from torchrl_sparse.data.hdf5_nodes import DAMAGE, Node
from torchrl_sparse.errors import InputError

__all__ = ["ArrayReader", "demo_group", "demo_names", "each_path", "open_demo", "open_demos"]

_NAME = re.compile(r"demo_[0-9]{1,9}")


@contextmanager
def open_demos(path: str | Path) -> Iterator[Node]:
    """Open a demonstration file for reading and lend its root.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: if it is no complete HDF5 file; of a truncated one the message names the first demonstration that is
            damaged, unless the index of demonstrations is lost with it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a file of demonstrations, got none")
    try:
        file = h5py.File(path, "r")
    except DAMAGE as error:
        said = " ".join(str(error).split())
        raise InputError(
            f"{path}: expected a complete HDF5 file, got one that h5py cannot open ({said}); {_first_loss(path)}"
        ) from error
    with file:
        yield Node(str(path), file)


def each_path(paths: str | Path | Sequence[str | Path]) -> list[str | Path]:
    """Return one path or several as a list.

    >>> each_path("data/lift.h5"), each_path(["a.h5", "b.h5"])
    (['data/lift.h5'], ['a.h5', 'b.h5'])
    """
    return [paths] if isinstance(paths, str | Path) else list(paths)


def demo_names(file: Node, filter_key: str | None = None) -> list[str]:
    """Return the names of the demonstrations in an open file, in numerical order.

    Args:
        file: the file.
        filter_key: only those that the file lists as ``mask/<filter_key>``, e.g. "train" or "better".

    Raises:
        InputError: if there are none, or no such filter key, or it lists a demonstration that is not there.

    Examples:
        >>> with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        ...     _ = file.create_group("data/demo_10"), file.create_group("data/demo_9")
        ...     demo_names(Node("in memory", file))
        ['demo_9', 'demo_10']
    """
    there = demo_group(file).names()
    names = [name for name in there if _NAME.fullmatch(name)]
    if not names:
        raise InputError(f"{file.where}: expected groups data/demo_<number>, got {there[:5]}")
    most = most_demos(file.file_size())
    if len(names) > most:
        raise InputError(
            f"{file.where}: expected at most {most} demonstrations in a file of its size, got {len(names)}"
        )
    if filter_key is not None:
        names = _filtered(file, filter_key, names)
    return sorted(names, key=lambda name: int(name[5:]))


def demo_group(file: Node) -> Node:
    """Return the group that holds an open file's demonstrations; `open_demo` opens one of them.

    Raises:
        InputError: naming the file, if there is none.
    """
    data = file.find("data", where=file.where)
    if data is None or not data.is_group:
        raise InputError(f"{file.where}: expected a group 'data', got {file.names()[:5]}")
    return data


def open_demo(data: Node, name: str) -> tuple[Node, int]:
    """Return the demonstration ``name`` and its number of steps, the attribute ``num_samples``.

    Raises:
        InputError: if the demonstration is damaged or elsewhere, or does not tell.
    """
    demo = data.group(name)
    return demo, demo.count("num_samples")


class ArrayReader:
    """Reader of an open file's arrays, whose total size is limited by the file's size.

    Args:
        file: the file, or an entry of it.
        small: bytes that may be read if the file is small, see `Room`.
    """

    def __init__(self, file: Node, small: int = ARRAYS) -> None:
        self._room = Room(file.file_size(), small)

    def numbers(self, demo: Node, name: str, length: int) -> np.ndarray:
        """Return one array f64 [length, n] of a demonstration, checked to be finite.

        Raises:
            InputError: naming it, if it is missing, damaged, too large or of another shape.
        """
        array = _array(demo, name)
        shape = self._room.enter(array, np.dtype(np.float64).itemsize).shape or ()
        if len(shape) != 2 or shape[0] != length or not length:
            raise InputError(
                f"{array.where}: expected shape [{length} = num_samples > 0, n], got {list(shape)}"
            )
        value = array.read(dtype=np.float64)
        if not np.isfinite(value).all():
            raise InputError(f"{array.where}: expected finite numbers, got {value[~np.isfinite(value)][0]}")
        return value

    def images(self, demo: Node, name: str, length: int) -> np.ndarray:
        """Return images u8 [length, h, w, 3] of a demonstration.

        Raises:
            InputError: naming them, if they are missing, damaged, too many or of another shape or type.
        """
        array = _array(demo, name)
        layout = self._room.enter(array, 1)
        shape = layout.shape or ()
        if layout.dtype != np.uint8 or len(shape) != 4 or (shape[0], shape[3]) != (length, 3):
            raise InputError(
                f"{array.where}: expected uint8 [{length}, h, w, 3], got {layout.dtype} {list(shape)}"
            )
        return array.read()


def _array(demo: Node, name: str) -> Node:
    array = demo.find(name)
    if array is None or not array.is_array:
        raise InputError(f"{demo.where}: expected a dataset {name!r}, got {demo.array_names()[:20]}")
    return array


def _filtered(file: Node, filter_key: str, names: list[str]) -> list[str]:
    masks, mask = file.find("mask"), file.find(f"mask/{filter_key}")
    if mask is None or not mask.is_array:
        there = ", ".join(masks.names()[:20]) if masks is not None and masks.is_group else ""
        raise InputError(f"{file.where}: expected a filter key mask/{filter_key}, got {there or 'none'}")
    layout = mask.layout()
    shape = layout.shape or ()
    if len(shape) != 1 or not layout.is_text or shape[0] > len(names):
        raise InputError(f"{mask.where}: expected names of demonstrations, got {layout.dtype} {list(shape)}")
    known, listed = {*names}, []
    for index in range(shape[0]):  # one by one: each may be of any length
        listed.append(mask.read_text(index))
        if listed[-1] not in known:
            raise InputError(f"{mask.where}: expected demonstrations of the file, got {listed[-1][:80]}")
    if not listed:
        raise InputError(f"{mask.where}: expected at least one demonstration, got none")
    return listed


def _first_loss(path: Path) -> str:
    """Describe where a truncated file breaks off."""
    room = Room(path.stat().st_size, IMAGES)
    try:
        with open(path, "rb") as raw, h5py.File(_Endless(raw), "r") as opened:
            file = Node(str(path), opened)
            for name in demo_names(file):
                try:
                    demo_group(file).group(name).visit(partial(_read_through, room))
                except DAMAGE:
                    return f"{name} is the first demonstration that is damaged"
    except DAMAGE:
        pass
    return "its index of demonstrations is lost"


def _read_through(room: Room, name: str, node: Node) -> None:
    if node.is_array:
        room.enter(node, 1)
        node.read_through()


class _Endless(io.RawIOBase):
    """A file that does not tell where it ends: HDF5 refuses to open a truncated file, and so could not say which part is
    intact."""

    def __init__(self, raw: io.BufferedReader):
        self._raw, self._at = raw, 0

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = 2**62 if whence == io.SEEK_END else offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        self._raw.seek(self._at)
        read = self._raw.readinto(buffer)
        if read < len(buffer):
            raise OSError(f"the file ends at byte {self._at + read}")
        return read
