"""Writer of exported policy files, ``tsp/1``, which ``tsp.cpp`` reads.

A header of sizes, little-endian, and then arrays in a fixed order, whose lengths follow from these sizes. Each begins on a
cache line, so that the file can be computed with where it lies. There is no offset in it.
"""

from __future__ import annotations

import ctypes
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.native.layout import CONSTANTS, Header, Matrix, Model
from torchrl_sparse.blocks.engine.native.packing import PackedNetwork
from torchrl_sparse.blocks.engine.native.pruner import NativePruner
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["VERSION", "ExportedPlan", "write_tsp"]

VERSION = CONSTANTS["TSP_VERSION"]
_LINE, _CHECKED_FROM = CONSTANTS["CACHE_LINE"], CONSTANTS["TSP_CHECKED_FROM"]
_BOTH = {field[0] for field in Header._fields_} & {field[0] for field in Model._fields_}


@dataclass(frozen=True)
class ExportedPlan:
    """The plan of a policy's calls, in a form that needs no Python.

    Attributes:
        slots: outputs that are kept, :func:`~torchrl_sparse.blocks.mask.num_buffers`.
        mask: bool [K, 3L] of every call; None where nothing is pruned, or where a pruner decides.
        pruner: decides for each observation.
        rate: the pruner's input where it reads one, else None.
    """

    slots: int
    mask: Tensor | None = None
    pruner: NativePruner | None = None
    rate: float | None = None

    def fields(self) -> dict[str, float]:
        """Return the plan's fields of the file header."""
        if self.pruner is None:
            return {"slots": self.slots, "plan": CONSTANTS["DENSE" if self.mask is None else "MASK"]}
        found = self.pruner.packed
        fields = {
            "slots": self.slots,
            "plan": CONSTANTS["PRUNER"],
            "hidden": self.pruner.hidden,
            "bias": found.bias,
        }
        if self.rate is None:
            return fields
        pruned = (torch.tensor(self.rate) * found.count).round().long()  # as rate_threshold counts them
        most = found.count - found.first - 1
        return fields | {"rated": 1, "rate": self.rate, "pruned": int(pruned.clamp(1, most))}


def write_tsp(
    path: Path, network: PackedNetwork, normalizer: list[Tensor], plan: ExportedPlan, description: str
) -> None:
    """Write an exported policy file completely or not at all.

    Args:
        path: of the file.
        network: with its sampler.
        normalizer: scale and offset of states, scale and offset of actions, one vector each.
        plan: what is skipped.
        description: JSON.
    """
    model, text = network.model, description.encode()
    arrays = [text, *(_bytes(vector) for vector in normalizer), *_network(model), *_plan(plan)]
    body = b"".join(array + bytes(-len(array) % _LINE) for array in arrays)
    head = ctypes.sizeof(Header)
    start = -(-head // _LINE) * _LINE
    header = Header(
        magic=CONSTANTS["TSP_MAGIC"].encode(),
        version=VERSION,
        size=start + len(body),
        weights=model.layer[0].qkv.type,
        description=len(text),
        **{name: getattr(model, name) for name in _BOTH},
        **plan.fields(),
    )
    content = bytearray(bytes(header) + bytes(start - head) + body)
    header.checksum = zlib.crc32(memoryview(content)[_CHECKED_FROM:])
    content[:head] = bytes(header)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _network(model: Model) -> Iterator[bytes]:
    width, vectors = model.embed.columns, model.steps * model.layers * model.heads
    yield from _matrix(model.embed, model.horizon)
    yield from _matrix(model.head)
    yield from _matrix(model.encode_up, model.obs_steps)
    yield from _matrix(model.encode_down)
    yield _floats(model.time_key, vectors * width)
    yield _floats(model.time_value, vectors * width)
    yield _floats(model.time_bias, vectors)
    yield _floats(model.coefficients, model.steps * CONSTANTS["COEFFICIENTS"])
    yield _floats(model.valid, width)
    for layer in model.layer[: model.layers]:
        for matrix in (layer.qkv, layer.out, layer.up, layer.down, layer.kv, *layer.fold[: 2 * model.heads]):
            yield from _matrix(matrix)
        yield _floats(layer.query_bias, layer.out.rows * (2 if layer.out.type == CONSTANTS["BF16"] else 1))
        yield _floats(layer.cross_bias, width)


def _plan(plan: ExportedPlan) -> Iterator[bytes]:
    if plan.mask is not None:
        yield plan.mask.contiguous().numpy().tobytes()
    if plan.pruner is not None:
        found = plan.pruner.packed
        yield from _matrix(found.obs)
        yield from _matrix(found.middle)
        yield _floats(found.cells, found.count * found.middle.columns)
        yield _floats(found.last, found.middle.columns)


def _matrix(matrix: Matrix, biases: int = 1) -> Iterator[bytes]:
    yield ctypes.string_at(
        matrix.weight, matrix.rows * matrix.columns * (2 if matrix.type == CONSTANTS["F16"] else 4)
    )
    yield _floats(matrix.bias, biases * matrix.columns)


def _floats(address: int, count: int) -> bytes:
    return ctypes.string_at(address, 4 * count)


def _bytes(vector: Tensor) -> bytes:
    return vector.detach().cpu().float().contiguous().numpy().tobytes()
