"""Matrices and constants in the memory layout of ``layout.h``.

A matrix [columns, rows] of PyTorch is cut into parts of 256 rows and these into panels of 32 columns,
[part][panel][row][32].
"""

from __future__ import annotations

import contextlib
import mmap

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.blocks.engine.native.layout import CONSTANTS, Matrix
from torchrl_sparse.errors import InputError

__all__ = ["PANEL", "Arena", "pack_panels", "padded", "quantise"]

PANEL, PART, _CACHE_LINE = (CONSTANTS[name] for name in ("PANEL", "PART", "CACHE_LINE"))
_TYPES = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.int8: "I8"}
_TOGETHER = {torch.bfloat16: 2, torch.int8: 4}  # inputs that lie side by side


def pack_panels(weight: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Lay a matrix out in the order in which ``kernels.h`` reads it.

    Args:
        weight: [columns, rows], as ``nn.Linear`` keeps it (outputs, inputs).
        dtype: torch.float32, torch.float16, torch.bfloat16 or, for whole numbers from -127 to 127, torch.int8. Of
            bfloat16 each two rows become one of i32, the first in the lower half, and of int8 each four: CPUs multiply
            them together.

    Returns:
        flat, part after part of up to 256 rows, in each [ceil(columns / 32), rows of the part, 32]; zero where there
        is no column.

    Raises:
        InputError: if a weight is too large for ``dtype``.

    Examples:
        >>> pack_panels(torch.ones(40, 7)).view(2, 7, 32)[1, 0].sum()
        tensor(8.)
    """
    rounded = weight.to(dtype)
    if not rounded.isfinite().all():
        raise InputError(
            f"weights: expected finite numbers within the range of {dtype}, got {weight.abs().max():g}"
        )
    if dtype in _TOGETHER:
        missing = -weight.shape[1] % _TOGETHER[dtype]
        rounded = functional.pad(rounded, (0, missing)).contiguous().view(torch.int32)
    columns, rows = rounded.shape
    panels = functional.pad(rounded, (0, 0, 0, -columns % PANEL)).view(-1, PANEL, rows).transpose(1, 2)
    return torch.cat([part.flatten() for part in panels.split(PART, dim=1)])


def quantise(weight: Tensor) -> tuple[Tensor, Tensor]:
    """Round each column of a matrix to 8 bits separately: ``weight`` [columns, rows] is about ``scale[:, None] * integers``.

    Returns:
        integers, -127 to 127, in the type of ``weight``, and scale [columns].

    Examples:
        >>> quantise(torch.tensor([[0.5, -1.0], [0.0, 0.0]]))
        (tensor([[  64., -127.],
                [   0.,    0.]]), tensor([0.0079, 0.0000]))
    """
    scale = weight.abs().amax(dim=1) / 127
    return (weight / scale[:, None]).nan_to_num(0).round(), scale


def padded(tensor: Tensor, multiple: int, dim: int) -> Tensor:
    """Append zeros to ``tensor`` until its size in ``dim`` is a multiple of ``multiple``.

    >>> padded(torch.ones(2, 3), 4, dim=1).shape
    torch.Size([2, 4])
    """
    missing = -tensor.shape[dim] % multiple
    behind = tensor.ndim - 1 - dim % tensor.ndim
    return functional.pad(tensor, (0, 0) * behind + (0, missing))


class Arena:
    """Memory for constants, in huge pages where the system has them, so that streaming weights causes few TLB misses."""

    _BLOCK = 32 << 20

    def __init__(self) -> None:
        self._blocks: list[Tensor] = []
        self._used = self._size = 0

    def keep(self, tensor: Tensor) -> int:
        """Copy ``tensor`` and return the address of the copy, aligned to a cache line."""
        tensor = tensor.contiguous().view(-1).view(torch.uint8)
        if self._used + tensor.numel() > self._size:
            self._size = max(self._BLOCK, tensor.numel())
            self._used = 0
            self._blocks.append(torch.frombuffer(_pages(self._size), dtype=torch.uint8))
        place = self._blocks[-1][self._used : self._used + tensor.numel()].copy_(tensor)
        self._used += -(-tensor.numel() // _CACHE_LINE) * _CACHE_LINE
        return place.data_ptr()

    def floats(self, tensor: Tensor) -> int:
        """Copy ``tensor`` as f32 and return the address of the copy."""
        return self.keep(tensor.float())

    def columns(self, tensor: Tensor) -> int:
        """Copy ``tensor`` [..., d] as f32, padded to whole panels of columns, and return the address of the copy."""
        return self.floats(padded(tensor, PANEL, dim=-1))

    def matrix(self, weight: Tensor, bias: Tensor, dtype: torch.dtype = torch.float32) -> Matrix:
        """Pack a layer's ``weight`` [columns, rows] and ``bias``: [columns], or [n, columns] for a product of n rows."""
        columns, rows = weight.shape
        bias = functional.pad(bias, (0, -columns % PANEL))
        integers = {}
        if dtype == torch.int8:
            weight, scale = quantise(weight)
            sums = weight.sum(dim=1).to(torch.int32)
            scale, sums = (functional.pad(part, (0, -columns % PANEL)) for part in (scale, sums))
            integers = {"scale": self.floats(scale), "sums": self.keep(sums)}
        return Matrix(
            weight=self.keep(pack_panels(weight, dtype)),
            bias=self.floats(bias),
            rows=-(-rows // _TOGETHER.get(dtype, 1)),
            columns=bias.shape[-1],
            bias_stride=bias.shape[-1] if bias.ndim == 2 else 0,
            type=CONSTANTS[_TYPES[dtype]],
            **integers,
        )


def _pages(size: int) -> mmap.mmap:
    if not hasattr(mmap, "MADV_HUGEPAGE"):
        return mmap.mmap(-1, size)
    # Private, because memory that processes share, the default here, is not given large pages.
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    # A kernel without large pages refuses, and nothing is lost.
    with contextlib.suppress(OSError):
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory
