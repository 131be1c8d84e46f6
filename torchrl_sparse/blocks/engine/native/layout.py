"""Memory layout shared by Python and C++, read from ``layout.h``, which C++ includes."""

from __future__ import annotations

import ast
import ctypes
import re
from ctypes import POINTER, c_char, c_float, c_int32, c_uint32, c_uint64, c_void_p
from pathlib import Path
from typing import Any

__all__ = ["CONSTANTS", "Header", "Layer", "Matrix", "Model", "Pruner", "Units", "layout_hash"]

CONSTANTS: dict[str, Any] = {}
_FIELDS: dict[str, list[tuple[str, str]]] = {}  # of a structure: types and names
for _kind, _first, _second in re.findall(
    r"^(CONSTANT|STRUCT|FIELD)\((.+?)(?:, (\S+))?\)",
    Path(__file__).with_name("layout.h").read_text(encoding="utf-8"),
    re.MULTILINE,
):
    if _kind == "CONSTANT":
        CONSTANTS[_first] = ast.literal_eval(_second)
    elif _kind == "STRUCT":
        _FIELDS[_first] = _found = []
    else:
        _found.append((_first, _second))

_TYPES: dict[str, Any] = {
    "float": c_float,
    "int32_t": c_int32,
    "uint32_t": c_uint32,
    "uint64_t": c_uint64,
    "Magic": c_char * 8,
    **dict.fromkeys(("const void*", "const float*", "const int32_t*"), c_void_p),
}


def _as_described(structure: type[ctypes.Structure]) -> type[ctypes.Structure]:
    """Give a class the fields of the structure of its name, and let those after it have fields of it."""
    name = structure.__name__
    structure._fields_ = [(field, _TYPES[kind]) for kind, field in _FIELDS[name]]
    _TYPES[name], _TYPES[f"const {name}*"] = structure, POINTER(structure)
    return structure


@_as_described
class Matrix(ctypes.Structure):
    """A packed matrix; :meth:`~torchrl_sparse.blocks.engine.native.arena.Arena.matrix` makes one."""


@_as_described
class Layer(ctypes.Structure):
    """The packed matrices of a transformer layer."""


@_as_described
class Model(ctypes.Structure):
    """A packed network and its sampler."""


@_as_described
class Pruner(ctypes.Structure):
    """The packed MLP of a learned planner."""


@_as_described
class Units(ctypes.Structure):
    """Scales and offsets of states and actions."""


@_as_described
class Header(ctypes.Structure):
    """The header of an exported policy."""


def layout_hash() -> int:
    """Hash the names, types, values and offsets of the layout as compiled code does (``structs.h``): FNV-1a, 64 bits."""
    parts: list[str | int] = []
    for name, value in CONSTANTS.items():
        parts += name, value
    for name, fields in _FIELDS.items():
        parts += name, ctypes.sizeof(_TYPES[name])
        for kind, field in fields:
            place = getattr(_TYPES[name], field)
            parts += kind, field, place.offset, place.size
    found = 0xCBF29CE484222325
    for part in parts:
        for byte in part.encode() if isinstance(part, str) else part.to_bytes(8, "little"):
            found = (found ^ byte) * 0x100000001B3 % 2**64
    return found
