"""Reader of ``torch.save`` files as data: a zip archive with a pickle and the bytes of its tensors."""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.published.inert_pickle import PLAIN, Name, read_pickle

__all__ = ["StoredTensor", "TorchArchive"]

_DTYPES = {
    "torch.FloatStorage": torch.float32,
    "torch.DoubleStorage": torch.float64,
    "torch.HalfStorage": torch.float16,
    "torch.BFloat16Storage": torch.bfloat16,
    "torch.LongStorage": torch.int64,
    "torch.IntStorage": torch.int32,
    "torch.ShortStorage": torch.int16,
    "torch.CharStorage": torch.int8,
    "torch.ByteStorage": torch.uint8,
    "torch.BoolStorage": torch.bool,
}
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
)
_MAX_AXES = 8
_READS = 4  # how often, on average, an archive's bytes may be read: tensors that share a storage each read it


@dataclass(frozen=True)
class _Storage:
    record: str
    dtype: torch.dtype
    numel: int


@dataclass(frozen=True)
class StoredTensor:
    """A tensor of an archive, not yet read; its range has been checked to lie in its storage."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


class TorchArchive:
    """An open ``torch.save`` file. Nothing in it is executed, and tensors are read one by one.

    A tensor's description is compared with its record before it is read, and all tensors that are read take at most a few times
    the file's size.

    Args:
        path: the file.

    Raises:
        InputError: if it is no such file, or is truncated.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "file.ckpt"
        >>> torch.save({"weight": torch.ones(2)}, path)
        >>> with TorchArchive(path) as archive:
        ...     archive.tensor(archive.contents()["weight"])
        tensor([1., 1.])
    """

    def __init__(self, path: Path) -> None:
        try:
            self._zip = zipfile.ZipFile(path)
        except _DAMAGED as error:
            raise InputError(
                f"expected a complete zip archive, as torch.save writes it, got: {error}"
            ) from error
        pickles = [
            name for name in self._zip.namelist() if name.count("/") == 1 and name.endswith("/data.pkl")
        ]
        if len(pickles) != 1:
            self._zip.close()
            raise InputError(f"expected one entry <name>/data.pkl in the archive, got {len(pickles)}")
        self._folder = pickles[0].removesuffix("data.pkl")
        self._size = path.stat().st_size
        self._unread = _READS * self._size

    def __enter__(self) -> TorchArchive:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def contents(self, known: Mapping[str, Callable[..., Any] | None] = PLAIN) -> Any:
        """Return the saved object with each tensor replaced by a `StoredTensor`.

        Args:
            known: names that the pickle may mention besides those of tensors, see `read_pickle`.

        Raises:
            InputError: if the pickle is damaged or asks for anything else, or a tensor's record has another length.
        """
        if f"{self._folder}byteorder" in self._zip.namelist():
            order = self._read("byteorder")
            if order != b"little":
                raise InputError(f"byteorder: expected little, got {order[:20]!r}")
        names = {"torch._utils._rebuild_tensor_v2": _rebuild, **dict.fromkeys(_DTYPES)}
        return read_pickle(self._read("data.pkl"), {**known, **names}, self._storage)

    def tensor(self, stored: StoredTensor) -> Tensor:
        """Read one tensor.

        Raises:
            InputError: if its bytes are missing or damaged.
        """
        storage = stored.storage
        data = self._read(f"data/{storage.record}")
        if not data:
            return torch.empty(stored.shape, dtype=storage.dtype)
        flat = torch.frombuffer(bytearray(data), dtype=storage.dtype)
        return flat.as_strided(stored.shape, stored.stride, stored.offset).clone()

    def _read(self, record: str) -> bytes:
        entry = self._entry(record)
        self._unread -= entry.file_size
        if self._unread < 0:
            raise InputError(
                f"{record}: expected tensors with storages of their own, got some that share {entry.file_size} bytes"
            )
        try:
            return self._zip.read(entry)
        except _DAMAGED as error:
            raise InputError(f"{record}: cannot be read: {error}") from error

    def _entry(self, record: str) -> zipfile.ZipInfo:
        """Return the entry of a record, checked to be stored as it is and to lie within the file."""
        try:
            entry = self._zip.getinfo(self._folder + record)
        except KeyError as error:
            raise InputError(f"{record}: expected an entry of this name, got none") from error
        # torch stores; a compressed entry could unfold into more than there is memory for.
        if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size:
            raise InputError(f"{record}: expected an entry that is not compressed")
        if entry.file_size > self._size:
            raise InputError(
                f"{record}: expected at most the file's {self._size} bytes, got {entry.file_size}"
            )
        return entry

    def _storage(self, identity: Any) -> _Storage:
        if not isinstance(identity, tuple) or len(identity) != 5 or identity[0] != "storage":
            raise InputError("expected references to storages, got another persistent id")
        _, kind, record, _, numel = identity
        dtype = _DTYPES.get(kind.path) if isinstance(kind, Name) else None
        if dtype is None or not isinstance(record, str) or not _is_size(numel):
            raise InputError("expected a storage of a known type, with the name of its record and its size")
        length = self._entry(f"data/{record}").file_size
        if length != numel * dtype.itemsize:
            raise InputError(f"data/{record}: expected {numel * dtype.itemsize} bytes, got {length}")
        return _Storage(record, dtype, numel)


def _rebuild(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> StoredTensor:
    sizes_fit = isinstance(shape, tuple) and isinstance(stride, tuple) and len(shape) == len(stride)
    if (
        not isinstance(storage, _Storage)
        or not sizes_fit
        or len(shape) > _MAX_AXES
        or not all(map(_is_size, (offset, *shape, *stride)))
    ):
        raise InputError("expected a tensor as storage, offset, shape and stride")
    last = offset + sum((size - 1) * step for size, step in zip(shape, stride, strict=True))
    if math.prod(shape) and (last >= storage.numel or math.prod(shape) > storage.numel):
        raise InputError(f"expected a tensor within its storage of {storage.numel}, got shape {shape}")
    return StoredTensor(storage, offset, shape, stride)


def _is_size(value: Any) -> bool:
    return type(value) is int and value >= 0
