"""Reader of GGUF, llama.cpp's format of language models: header and dequantised tensors. Data only; nothing is executed.

A file is ``"GGUF" | version | counts | metadata | descriptions of tensors | their data``, little-endian throughout. Quantised
are blocks of 32 numbers with a scale of their own. Every length is compared with the bytes that are there before it is used.
llama.cpp's own package ``gguf`` does not: 60 bytes that claim 2**36 numbers keep it reading without end. Tests hold what is
read against it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.errors import InputError

__all__ = ["GGUF"]

_MAGIC, _VERSIONS, _ALIGNMENT, _MAX_DIMS = b"GGUF", (2, 3), 32, 4
_SCALARS = {0: "B", 1: "b", 2: "H", 3: "h", 4: "I", 5: "i", 6: "f", 7: "?", 10: "Q", 11: "q", 12: "d"}
_STRING, _ARRAY = 8, 9
_BLOCK = 32


def _f32(data: np.ndarray) -> np.ndarray:
    return data.view("<f4")


def _f16(data: np.ndarray) -> np.ndarray:
    return data.view("<f2").astype(np.float32)


def _q8_0(data: np.ndarray) -> np.ndarray:
    """``scale f16 | 32 x i8``."""
    blocks = data.reshape(-1, 2 + _BLOCK)
    return _f16(blocks[:, :2].copy()) * blocks[:, 2:].view(np.int8)


def _q4_1(data: np.ndarray) -> np.ndarray:
    """``scale f16 | least f16 | 16 bytes``: numbers 0 to 15 are the bytes' low halves, 16 to 31 the high ones."""
    blocks = data.reshape(-1, 4 + _BLOCK // 2)
    numbers = np.concatenate([blocks[:, 4:] & 15, blocks[:, 4:] >> 4], axis=1)
    return _f16(blocks[:, :2].copy()) * numbers + _f16(blocks[:, 2:4].copy())


_TYPES = {
    0: ("F32", 1, 4, _f32),
    1: ("F16", 1, 2, _f16),
    3: ("Q4_1", _BLOCK, 20, _q4_1),
    8: ("Q8_0", _BLOCK, 34, _q8_0),
}
"""A type's number -> its name, numbers and bytes of a block, and what turns bytes into f32."""


@dataclass(frozen=True)
class _Stored:
    shape: tuple[int, ...]
    kind: int
    offset: int


class GGUF:
    """A memory-mapped GGUF file.

    Args:
        path: the file.

    Attributes:
        metadata: what its header says, numbers, texts, and lists of these, by name.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming the file, if it is damaged, cut off, or no such file.
    """

    def __init__(self, path: Path):
        self.path = path
        if not path.is_file():
            raise FileNotFoundError(f"expected a file {path}, got none")
        if not path.stat().st_size:  # which cannot be mapped
            raise self._fault("expected a GGUF file, got an empty one")
        self._bytes = np.memmap(path, np.uint8, mode="r")
        self._at = 0
        if (magic := bytes(self._take(4))) != _MAGIC:
            raise self._fault(f"expected a GGUF file, which begins with {_MAGIC!r}, got {magic!r}")
        if (version := self._number("I")) not in _VERSIONS:
            raise self._fault(f"expected GGUF of version 2 or 3, got {version}")
        tensors, entries = self._number("Q"), self._number("Q")
        self.metadata = {name: self._value(self._number("I")) for name in self._names(entries)}
        self._tensors = {name: self._description() for name in self._names(tensors)}
        alignment = self.metadata.get("general.alignment", _ALIGNMENT)
        if type(alignment) is not int or alignment < 1:
            raise self._fault(f"general.alignment: expected a positive number, got {alignment}")
        self._data = math.ceil(self._at / alignment) * alignment

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Tensor shapes in PyTorch's order, by name."""
        return {name: stored.shape for name, stored in self._tensors.items()}

    def tensor(self, name: str) -> Tensor:
        """Return a dequantised tensor, f32.

        Raises:
            InputError: if it is of a type that is not read, cut off, or its numbers are not finite.
        """
        stored = self._tensors[name]
        if stored.kind not in _TYPES:
            known = ", ".join(f"{kind} {number}" for number, (kind, *_) in _TYPES.items())
            raise self._fault(f"{name}: expected one of the types {known}, got {stored.kind}")
        _, numbers, size, dequantise = _TYPES[stored.kind]
        if stored.shape[-1] % numbers:
            raise self._fault(f"{name}: expected rows of whole blocks of {numbers}, got {stored.shape}")
        self._at = self._data + stored.offset
        values = dequantise(self._take(math.prod(stored.shape) // numbers * size))
        tensor = torch.from_numpy(values.astype(np.float32).reshape(stored.shape))
        if not tensor.isfinite().all():
            raise self._fault(f"{name}: expected finite numbers, got NaN or infinity")
        return tensor

    # -- the header ----------------------------------------------------------------------------------------------------

    def _take(self, count: int) -> np.ndarray:
        """Return the next ``count`` bytes."""
        if count > len(self._bytes) - self._at:
            raise self._fault(
                f"expected {count} bytes from byte {self._at}, got a file of {len(self._bytes)}"
            )
        self._at += count
        return self._bytes[self._at - count : self._at]

    def _number(self, form: str) -> Any:
        return struct.unpack(f"<{form}", self._take(struct.calcsize(f"<{form}")).tobytes())[0]

    def _text(self) -> str:
        data = self._take(self._number("Q")).tobytes()
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise self._fault(f"expected text in UTF-8 before byte {self._at}, got {data[:20]!r}") from error

    def _names(self, count: int) -> Iterator[str]:
        return (self._text() for _ in range(count))

    def _value(self, kind: int) -> Any:
        if kind != _ARRAY:
            return self._text() if kind == _STRING else self._number(self._form(kind))
        kind, count = self._number("I"), self._number("Q")
        if kind == _STRING:
            return [*self._names(count)]
        form = self._form(kind)  # lists of lists are not read
        return np.frombuffer(self._take(count * struct.calcsize(f"<{form}")).tobytes(), f"<{form}").tolist()

    def _form(self, kind: int) -> str:
        if kind not in _SCALARS:
            raise self._fault(f"expected a type of {sorted(_SCALARS)} before byte {self._at}, got {kind}")
        return _SCALARS[kind]

    def _description(self) -> _Stored:
        if not 1 <= (dims := self._number("I")) <= _MAX_DIMS:
            raise self._fault(f"expected 1 to {_MAX_DIMS} dimensions before byte {self._at}, got {dims}")
        shape = tuple(self._number("Q") for _ in range(dims))[::-1]
        return _Stored(shape, self._number("I"), self._number("Q"))

    def _fault(self, text: str) -> ValueError:
        return InputError(f"{self.path}: {text}")
