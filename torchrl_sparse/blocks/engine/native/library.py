"""The compiled library of ``native.cpp``: where it is, and which of its instruction sets this CPU supports.

It is built when the package is installed, as a plain shared library that knows nothing of Python or PyTorch, and is
called through ctypes, which releases the interpreter's lock.
"""

from __future__ import annotations

import ctypes
import importlib.machinery
import platform
import warnings
from ctypes import c_int32, c_int64, c_uint64, c_void_p
from functools import lru_cache
from pathlib import Path

from torchrl_sparse.blocks.engine.native.layout import layout_hash
from torchrl_sparse.errors import InputError

__all__ = ["INSTRUCTION_SETS", "instruction_level", "library", "loaded", "native_available"]

_OF_MACHINE = {"aarch64": ("neon",), "arm64": ("neon",)}
INSTRUCTION_SETS = (
    "portable",
    *_OF_MACHINE.get(platform.machine(), ("avx2", "avx512", "avx512_bf16", "amx")),
)
# Each function's result and arguments; c_void_p is any address, of a structure of layout.py or of numbers. Count INTERFACE of
# layout.h up whenever they change.
_SIGNATURES = {
    "sparse_levels": (c_int32, []),
    "sparse_layout": (c_uint64, []),
    "sparse_scratch": (c_int64, [c_void_p, c_int32]),
    "sparse_denoise": (None, [c_int32, c_int32, c_void_p, c_int32, c_void_p, c_int32, *[c_void_p] * 6]),
    "sparse_normalise": (c_int32, [c_void_p, c_int32, c_int32, *[c_void_p] * 2]),
    "sparse_answer": (None, [c_int32, c_int32, c_void_p, c_int32, c_void_p, c_int32, *[c_void_p] * 6]),
    "sparse_blocks": (None, [c_int32, c_int32, c_void_p, c_int32, c_void_p]),
    "sparse_gather": (None, [c_int32, *[c_void_p] * 2]),
    "sparse_prune": (None, [c_int32, c_int32, c_void_p, c_int32, *[c_void_p] * 3]),
}


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL | str:
    """Return the compiled library, or the reason why there is none; then also warn, once per process."""
    found = _load(Path(__file__).parent)
    if isinstance(found, str):
        warnings.warn(f"torchrl_sparse runs without its native engine: {found}", stacklevel=2)
    return found


@lru_cache(maxsize=1)
def loaded() -> ctypes.CDLL:
    """Return the compiled library; RuntimeError with the reason if there is none."""
    found = library()
    if isinstance(found, str):
        raise RuntimeError(f"native engine: {found}")
    return found


def _load(folder: Path) -> ctypes.CDLL | str:
    paths = [folder / f"_native{suffix}" for suffix in importlib.machinery.EXTENSION_SUFFIXES]
    path = next((path for path in paths if path.exists()), None)
    if path is None:
        return f"{paths[0].name} was not built (install a C++17 compiler, g++ or clang++, then this package again)"
    try:
        found = _declare(ctypes.CDLL(str(path)))
    except OSError as error:
        return f"{path.name} cannot be loaded ({error}); install the package again"
    except AttributeError:  # not a function of that name
        found = None
    if found is None or found.sparse_layout() != layout_hash():
        return (
            f"{path.name} was built from other sources than layout.h here; build it again: pip install -e ."
        )
    return found


def _declare(found: ctypes.CDLL) -> ctypes.CDLL:
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    return found


def native_available() -> tuple[bool, str]:
    """Return whether the library was built, and the instruction sets usable here or the reason why not.

    Examples:
        >>> available, reason = native_available()
        >>> isinstance(available, bool), isinstance(reason, str)
        (True, True)
    """
    found = library()
    if isinstance(found, str):
        return False, found
    return True, ", ".join(INSTRUCTION_SETS[: found.sparse_levels()])


def instruction_level(instruction_set: str | None = None) -> int:
    """Return the library's number of an instruction set; by default the widest that this CPU supports.

    Raises:
        InputError: if this CPU does not have it.
    """
    available = INSTRUCTION_SETS[: loaded().sparse_levels()]
    if instruction_set is None:
        return len(available) - 1
    if instruction_set not in available:
        raise InputError(
            f"instruction_set: expected one of {list(available)} on this CPU, got {instruction_set!r}"
        )
    return available.index(instruction_set)
