"""The programs of a batch, as the PyTorch engine executes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.program import COMPUTE, build_program
from torchrl_sparse.blocks.mask import BLOCK_TYPES

__all__ = ["Loop", "Operation", "build_loop"]

_CA = BLOCK_TYPES.index("CA")

Operation = tuple[int, int, int, list[int] | Tensor | None]


@dataclass(frozen=True, eq=False)
class Loop:
    """Combined program of a batch.

    Attributes:
        steps: for each denoising step its operations (operation, first, last, rows), see
            :mod:`torchrl_sparse.blocks.engine.program`; ``rows`` says which rows of the batch compute a block, None
            means all.
        attends: for each denoising step, whether it computes cross-attention anywhere.
        dense: nothing is ever reused.
    """

    steps: list[list[Operation]]
    attends: list[bool]
    dense: bool


def build_loop(masks: np.ndarray, device: torch.device, gather: bool) -> Loop:
    """Compile the masks bool [B, K, 3L] of a batch to a loop, cached for the next batch with the same masks.

    Args:
        masks: True = pruned.
        device: where ``rows`` are wanted.
        gather: name rows by a list of indices, so that they can be computed alone; else by a bool tensor [B, 1].

    Examples:
        >>> masks = np.zeros((2, 2, 3), bool)
        >>> masks[0, 1, :2] = masks[1, 1, 1] = True
        >>> build_loop(masks, torch.device("cpu"), gather=True).steps[1]
        [(0, 0, 0, [1]), (1, 1, 2, None), (0, 2, 0, None)]
    """
    return _build_loop(masks.shape, masks.tobytes(), device, gather)


@lru_cache(maxsize=64)
def _build_loop(shape: tuple[int, ...], data: bytes, device: torch.device, gather: bool) -> Loop:
    masks = np.frombuffer(data, bool).reshape(shape)
    pruned_by_all = masks.all(axis=0)
    # Where some row computes, the operation is a COMPUTE of those rows.
    program = build_program(pruned_by_all)
    rows = _partial_rows(masks, pruned_by_all, device, gather)
    steps = [
        [
            (op, first, last, rows.get((k, first)) if op == COMPUTE else None)
            for op, first, last in program.step(k)
        ]
        for k in range(shape[1])
    ]
    attends = (~pruned_by_all[:, _CA :: len(BLOCK_TYPES)]).any(axis=1).tolist()
    return Loop(steps, attends, dense=not masks.any())


def _partial_rows(masks: np.ndarray, pruned_by_all: np.ndarray, device: torch.device, gather: bool) -> dict:
    """Map (step, block) to rows, wherever some rows compute a block and others do not."""
    cells = np.argwhere(masks.any(axis=0) & ~pruned_by_all)
    computed = ~masks[:, cells[:, 0], cells[:, 1]].T
    if gather:
        cell, row = np.nonzero(computed)
        bounds, row = np.searchsorted(cell, np.arange(len(cells) + 1)).tolist(), row.tolist()
        rows = [row[first:last] for first, last in pairwise(bounds)]
    else:
        rows = torch.from_numpy(computed[..., None]).to(device).unbind(0)  # in one transfer
    return dict(zip(map(tuple, cells.tolist()), rows, strict=True))
