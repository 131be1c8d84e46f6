"""openpi's messages: msgpack, with numpy arrays as maps of their bytes, dtype and shape. Reading one executes nothing."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from torchrl_sparse.envs.extras import import_extra
from torchrl_sparse.errors import InputError

__all__ = ["pack", "unpack"]

_CONTAINERS, _ITEMS, _RANK = 256, 1024, 8
"""Most maps and lists of a message, entries of each, and axes of an array: a short message cannot fill the memory."""
_NUMERIC = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")
_TEXT = re.compile(r"[<>|=]?U\d{1,6}")


def pack(content: Any) -> bytes:
    """Return a message of plain values and numpy arrays, as openpi's client reads it.

    >>> unpack(pack({"actions": np.ones((1, 2), np.float32)}))
    {'actions': array([[1., 1.]], dtype=float32)}
    """
    return _msgpack().packb(content, default=_pack_array)


def unpack(message: bytes | str) -> Any:
    """Return the content of a message as openpi's client packs it; arrays are read-only views of it.

    Raises:
        InputError: for text, and for what is no msgpack, arrays of other than plain numeric dtypes, or whose sizes do not
            match their bytes, and more maps and lists than an observation has.

    >>> unpack(b"no map")
    Traceback (most recent call last):
    ...
    torchrl_sparse.errors.InputError: message: expected msgpack, got 6 bytes that are none: unpack(b) received extra data.
    """
    if isinstance(message, str):
        raise InputError(f"message: expected msgpack, got text of {len(message)} characters")
    found = 0

    def count(content: Any) -> Any:
        nonlocal found
        found += 1
        if found > _CONTAINERS:
            raise InputError(f"message: expected at most {_CONTAINERS} maps and lists, got more")
        return _unpack_array(content) if isinstance(content, dict) else content

    msgpack = _msgpack()
    most = {"max_array_len": _ITEMS, "max_map_len": _ITEMS, "max_ext_len": 0}
    try:
        return msgpack.unpackb(message, object_hook=count, list_hook=count, **most)
    except InputError:
        raise
    except (
        ValueError,
        TypeError,
        msgpack.UnpackException,
        RecursionError,
    ) as error:  # ExtraData is a ValueError
        why = " ".join(str(error).split())[:100] or type(error).__name__
        raise InputError(
            f"message: expected msgpack, got {len(message)} bytes that are none: {why}"
        ) from error


@cache
def _msgpack() -> ModuleType:
    return import_extra("msgpack", "serve")


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray) and _NUMERIC.fullmatch(value.dtype.str):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic) and _NUMERIC.fullmatch(value.dtype.str):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"cannot pack {type(value).__name__}")


def _unpack_array(content: dict[Any, Any]) -> Any:
    if b"__ndarray__" in content:
        return _array(content.get(b"data"), content.get(b"dtype"), content.get(b"shape"))
    if b"__npgeneric__" in content:
        return _scalar(content.get(b"data"), content.get(b"dtype"))
    return content


def _array(data: Any, dtype: Any, shape: Any) -> np.ndarray:
    if not (isinstance(dtype, str) and _NUMERIC.fullmatch(dtype)):
        raise InputError(f"dtype: expected a plain numeric one, got {_short(dtype)}")
    axes: list[Any] = shape if isinstance(shape, list) else [None]
    if len(axes) > _RANK or not all(type(axis) is int and axis >= 0 for axis in axes):
        raise InputError(f"shape: expected at most {_RANK} whole numbers, got {_short(shape)}")
    kind = np.dtype(dtype)
    expected = math.prod(axes) * kind.itemsize
    if not isinstance(data, bytes) or len(data) != expected:
        got = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
        raise InputError(f"data: expected {expected} bytes of {dtype} {axes}, got {got}")
    return np.frombuffer(data, kind).reshape(axes)


def _scalar(data: Any, dtype: Any) -> Any:
    if isinstance(data, str) and isinstance(dtype, str) and _TEXT.fullmatch(dtype):
        return data
    if isinstance(dtype, str) and _NUMERIC.fullmatch(dtype) and isinstance(data, (bool, int, float)):
        with suppress(OverflowError), np.errstate(all="ignore"):
            value = np.asarray(data).astype(dtype)[()]
            if value == data or data != data:  # a number that was packed is one of its dtype
                return value
    raise InputError(
        f"dtype: expected a number of a plain numeric dtype, got {_short(data)} of {_short(dtype)}"
    )


def _short(value: Any) -> str:
    return repr(value)[:60]
