"""Writing of HDF5 files: completely or not at all, with one error when the disk is full."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import h5py

from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["new_hdf5"]


@contextmanager
def new_hdf5(path: str | os.PathLike) -> Iterator[h5py.File]:
    """Lend an empty HDF5 file that becomes ``path`` if the block succeeds, see `atomic_path`.

    Raises:
        OSError: if the disk is full, naming the file and its volume.

    >>> import tempfile
    >>> path = os.path.join(tempfile.mkdtemp(), "demo.h5")
    >>> with new_hdf5(path) as file:
    ...     file["actions"] = [1.0, 2.0]
    >>> h5py.File(path)["actions"][:].tolist()
    [1.0, 2.0]
    """
    with atomic_path(path) as temporary, open(temporary, "w+b", buffering=0) as raw:
        steady = _Steady(raw)
        try:
            with h5py.File(steady, "w") as file:
                yield file
        finally:
            if steady.error is not None:
                raise steady.error


class _Steady(io.RawIOBase):
    """A file that keeps the first error of writing to itself and from then on writes nothing.

    What HDF5 could not write it tries again when each of its objects is closed, and prints a traceback for every one.
    """

    def __init__(self, raw: io.FileIO):
        self._raw = raw
        self.error: OSError | None = None

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._raw.seek(offset, whence)

    def tell(self) -> int:
        return self._raw.tell()

    def readinto(self, buffer: Any) -> int:
        return self._raw.readinto(buffer)

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while len(left) and self.error is None:
                left = left[self._raw.write(left) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return self._raw.truncate(size)
        except OSError as error:
            self.error = self.error or error
            return self._raw.tell() if size is None else size
