"""Groups, arrays and attributes of HDF5 files that may be damaged.

Whatever of a file this library reads, it reads here: errors of h5py become one line that names the file and the entry.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from torchrl_sparse.errors import InputError

__all__ = ["DAMAGE", "Layout", "Node", "naming"]

DAMAGE = (OSError, RuntimeError, KeyError, TypeError, ValueError, OverflowError, MemoryError, AttributeError)
"""All that h5py raises of a damaged file."""


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Turn the errors that h5py raises on damaged files into a one-line ValueError that starts with ``where``."""
    try:
        yield
    except DAMAGE as error:
        raise InputError(f"{where}: cannot be read: {' '.join(str(error).split())}") from error


@dataclass(frozen=True)
class Layout:
    """Storage layout of an array.

    Attributes:
        shape: None of one that has no value.
        dtype: of its numbers.
        chunks: shape of a chunk; None if it is kept in one piece.
        is_text: it holds texts.
        is_elsewhere: its numbers are those of other files or arrays.
    """

    shape: tuple[int, ...] | None
    dtype: np.dtype
    chunks: tuple[int, ...] | None
    is_text: bool
    is_elsewhere: bool


class Node:
    """An entry of an open file.

    Args:
        where: what errors begin with: the file, and which entry.
        item: the entry.

    Examples:
        >>> with h5py.File("in memory", "w", driver="core", backing_store=False) as file:
        ...     _ = file.create_group("data/demo_0")
        ...     root = Node("in memory", file)
        ...     root.find("data/demo_0").where, root.find("data/demo_1"), root.names()
        ('in memory, data/demo_0', None, ['data'])
    """

    def __init__(self, where: str, item: h5py.Group | h5py.Dataset) -> None:
        self.where, self._item = where, item

    @property
    def is_group(self) -> bool:
        """True for a group or the whole file, False for an array."""
        return isinstance(self._item, h5py.Group)

    @property
    def is_array(self) -> bool:
        """True for an array."""
        return isinstance(self._item, h5py.Dataset)

    def at(self, where: str) -> Node:
        """Return the same entry, named ``where`` in errors."""
        return Node(where, self._item)

    def file_size(self) -> int:
        """Return the size of the entry's file, bytes."""
        with naming(self.where):
            return self._item.file.id.get_filesize()

    # -- groups --------------------------------------------------------------------------------------------------------

    def names(self) -> list[str]:
        """Return the names of a group's entries, sorted."""
        with naming(self.where):
            return sorted(self._item)

    def find(self, path: str, where: str | None = None) -> Node | None:
        """Return the entry at ``path`` of a group; None if there is none.

        Args:
            path: names, with a slash between them.
            where: what errors of that entry begin with; this one's and ``path`` by default.

        Raises:
            InputError: if it is damaged or a link to elsewhere.
        """
        where, item = where or f"{self.where}, {path}", self._item
        for part in path.split("/"):
            with naming(where):
                if not isinstance(item, h5py.Group) or not item.id.links.exists(part.encode()):
                    return None
                kind = item.id.links.get_info(part.encode()).type
            if kind != h5py.h5l.TYPE_HARD:
                raise InputError(f"{where}: expected {path!r} in the file itself, got a link to elsewhere")
            with naming(where):
                item = item[part]
        return Node(where, item)

    def array_names(self) -> list[str]:
        """Return the names of all arrays in a group and its subgroups, sorted."""
        names: list[str] = []
        self.visit(lambda name, node: names.append(name) if node.is_array else None)
        return sorted(names)

    def visit(self, see: Callable[[str, Node], Any]) -> None:
        """Call ``see`` on all entries of a group and its subgroups; its errors are passed on."""
        with naming(self.where):
            found: list[tuple[str, Any]] = []
            self._item.visititems(lambda name, item: found.append((name, item)))
        for name, item in found:
            see(name, Node(f"{self.where}, {name}", item))

    def group(self, path: str) -> Node:
        """Return the group at ``path``.

        Raises:
            InputError: as `find`, and if there is none or another kind of entry.
        """
        found = self.find(path)
        if found is None or not found.is_group:
            raise InputError(
                f"{self.where}, {path}: expected a group, got {'another kind of entry' if found else 'none'}"
            )
        return found

    def copy(self, target: h5py.Group, path: str) -> None:
        """Copy the entry at ``path``, if it exists, into a group of a new file, under its last name."""
        if (found := self.find(path)) is not None:
            found.copy_to(target, path.rpartition("/")[2])

    def copy_to(self, target: h5py.Group, name: str) -> None:
        """Copy this entry and its content into a group of a new file."""
        with naming(self.where):
            target.file.copy(self._item, target, name=name)

    # -- attributes ----------------------------------------------------------------------------------------------------

    def count(self, name: str, default: int | None = None) -> int:
        """Return the integer attribute ``name``.

        Raises:
            InputError: if it is anything else, or missing without a default.
        """
        found = self._attribute(name)
        if found is None and default is not None:
            return default
        if found is None:
            raise InputError(
                f"{self.where}: expected an attribute {name!r}, got {self.attribute_names()[:5]}"
            )
        if found[0] != () or found[1].kind not in "iu":
            raise InputError(
                f"{self.where}, {name}: expected a whole number, got {found[1]} {found[0] or ''}".rstrip()
            )
        return int(self._value(name))

    def text(self, name: str) -> str | None:
        """Return the text attribute ``name``; None if there is none.

        Raises:
            InputError: if it is anything else.
        """
        if (found := self._attribute(name)) is None:
            return None
        if found[0] != () or h5py.check_string_dtype(found[1]) is None:
            raise InputError(
                f"{self.where}, {name}: expected a text, got {found[1]} {found[0] or ''}".rstrip()
            )
        text = self._value(name)
        return text.decode(errors="replace") if isinstance(text, (bytes, np.bytes_)) else str(text)

    def flag(self, name: str) -> bool:
        """Return the boolean attribute ``name``.

        Raises:
            InputError: if it is missing or anything else.
        """
        found = self._attribute(name)
        if found is None or found[0] != () or found[1].kind != "b":
            raise InputError(
                f"{self.where}, {name}: expected true or false, got {found[1] if found else 'none'}"
            )
        return bool(self._value(name))

    def attribute_names(self) -> list[str]:
        """Return the names of all attributes, sorted."""
        with naming(self.where):
            return sorted(self._item.attrs)

    def told(self) -> dict[str, Any]:
        """Return all attributes by name."""
        return {name: self._value(name) for name in self.attribute_names()}

    def copy_attributes(self, target: h5py.Group) -> None:
        """Copy all attributes to a group of a new file."""
        for name, value in self.told().items():
            target.attrs[name] = value

    def _attribute(self, name: str) -> tuple[tuple[int, ...] | None, np.dtype] | None:
        """Return shape and type of an attribute; None if there is none."""
        with naming(f"{self.where}, {name}"):
            if name not in self._item.attrs:
                return None
            attribute = self._item.attrs.get_id(name)
            return attribute.shape, attribute.dtype

    def _value(self, name: str) -> Any:
        with naming(f"{self.where}, {name}"):
            return self._item.attrs[name]

    # -- arrays --------------------------------------------------------------------------------------------------------

    def layout(self) -> Layout:
        """Return the storage layout of an array."""
        with naming(self.where):
            item = self._item
            is_text = h5py.check_string_dtype(item.dtype) is not None
            return Layout(
                item.shape, item.dtype, item.chunks, is_text, bool(item.is_virtual or item.external)
            )

    def read(self, rows: Any = (), dtype: type | None = None) -> np.ndarray:
        """Return ``rows`` of an array, by default all; `torchrl_sparse.data.hdf5_bounds.Room` limits the size."""
        with naming(self.where):
            return np.asarray(self._item[rows], dtype=dtype)

    def read_through(self) -> None:
        """Read an array chunk by chunk without keeping it, to check that it is intact."""
        with naming(self.where):
            for part in self._item.iter_chunks() if self._item.chunks else [()]:
                self._item[part]

    def read_text(self, row: int) -> str:
        """Return one element of an array of texts."""
        with naming(self.where):
            return self._item.asstr()[row]

    def filters(self) -> list[int]:
        """Return the ids of an array's filters, such as compressions."""
        with naming(self.where):
            settings = self._item.id.get_create_plist()
            return [settings.get_filter(index)[0] for index in range(settings.get_nfilters())]

    def chunks_above(self, size: int) -> list[tuple[int, ...]]:
        """Return the offsets of the chunks that take more than ``size`` bytes of the file."""
        large: list[tuple[int, ...]] = []
        with naming(self.where):
            self._item.id.chunk_iter(
                lambda chunk: large.append(chunk.chunk_offset) if chunk.size > size else None
            )
        return large

    def stored_chunk(self, offset: tuple[int, ...]) -> bytes:
        """Return a chunk as stored, filters not undone."""
        with naming(self.where):
            return self._item.id.read_direct_chunk(offset)[1]
