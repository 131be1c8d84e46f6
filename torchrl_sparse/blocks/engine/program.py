"""Compilation of a prune mask to a program: the operations of one policy call, known before the denoising loop.

The native engine does the same operations, but finds them in the mask as it goes.

A denoising step of a program is a short list of operations on the residual stream ``x``. Pruned blocks come in
runs, and a run adds a sum of vectors that are already there, so it is one operation however long it is:

    COMPUTE   first, -     d = block_first(x); latest[first] = d; x = x + d
    REUSE     first, last  x = x + the sum of what the pruned blocks first .. last-1 add
    COLLAPSE  fresh, -     the only operation of a step that computes nothing: eps = head(LN(embed(sample) + c)),
                           c being the sum over *all* blocks; fresh = 1 if c must be summed again, 0 if it is still
                           that of the latest collapsed step

Blocks are the columns of the mask, :mod:`torchrl_sparse.blocks.mask` says which. The functions here are pure;
the engine gives the operations their arithmetic and knows the reuse rule: with ``"block"``, block b adds
``latest[b]``; with ``"type"`` all blocks of a type share one ``latest``, with ``"single"`` all blocks do, and a
run adds it as often as they occur in the run (:func:`slot_counts`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

__all__ = ["COLLAPSE", "COMPUTE", "REUSE", "Program", "build_program", "slot_counts"]

COMPUTE, REUSE, COLLAPSE = 0, 1, 2


@dataclass(frozen=True)
class Program:
    """The operations executed for one row of a batch.

    Attributes:
        ops: i32 [n, 3], (operation, first, last) in order of execution.
        starts: i32 [K + 1]; denoising step k executes ``ops[starts[k]:starts[k + 1]]``.
    """

    ops: np.ndarray
    starts: np.ndarray

    @property
    def num_steps(self) -> int:
        """Denoising steps K."""
        return len(self.starts) - 1

    def step(self, k: int) -> list[tuple[int, int, int]]:
        """Return the operations of denoising step ``k``, each as (operation, first, last)."""
        return [tuple(op) for op in self.ops[self.starts[k] : self.starts[k + 1]].tolist()]


def build_program(mask: Tensor | np.ndarray) -> Program:
    """Compile one mask to a program.

    The work is array arithmetic over the computed blocks, so that a new mask costs little next to its policy call.

    Args:
        mask: bool [K, 3L], True = pruned, row 0 all False (checked by the caller, see
            :func:`~torchrl_sparse.blocks.mask.validate_mask`).

    Examples:
        >>> mask = np.array([[0, 0, 0], [1, 1, 0], [1, 1, 1], [1, 1, 1]], dtype=bool)
        >>> program = build_program(mask)
        >>> [program.step(k) for k in range(1, 4)]
        [[(1, 0, 2), (0, 2, 0)], [(2, 1, 0)], [(2, 0, 0)]]
    """
    mask = np.asarray(mask)
    num_steps, num_blocks = mask.shape
    step, block = np.nonzero(~mask)
    opens = np.r_[True, step[1:] != step[:-1]]  # the first computed block of its step
    closes = np.r_[opens[1:], True]
    run_first = np.where(opens, 0, np.r_[0, block[:-1] + 1])
    before, after = run_first < block, closes & (block + 1 < num_blocks)
    collapsed = np.flatnonzero(mask.all(axis=1))
    fresh = np.r_[True, np.diff(collapsed) > 1][: len(collapsed)]

    # An operation is sorted in by the step and the block at which it starts.
    position = np.concatenate(
        [
            step * num_blocks + block,
            step[before] * num_blocks + run_first[before],
            step[after] * num_blocks + block[after] + 1,
            collapsed * num_blocks,
        ]
    )
    ops = np.zeros((len(position), 3), np.int32)
    runs = slice(len(step), len(position) - len(collapsed))
    ops[: len(step), 1] = block
    ops[runs, 0] = REUSE
    ops[runs, 1] = np.concatenate([run_first[before], block[after] + 1])
    ops[runs, 2] = np.concatenate([block[before], np.full(after.sum(), num_blocks)])
    ops[runs.stop :, 0] = COLLAPSE
    ops[runs.stop :, 1] = fresh
    order = np.argsort(position, kind="stable")
    starts = np.searchsorted(position[order], np.arange(num_steps + 1) * num_blocks)
    return Program(np.ascontiguousarray(ops[order]), starts.astype(np.int32))


def slot_counts(first: int, last: int, num_slots: int) -> tuple[int, ...]:
    """Count how many of the columns ``first .. last-1`` read each of ``num_slots`` buffers (column modulo number).

    >>> slot_counts(1, 6, num_slots=3)
    (1, 2, 2)
    """
    return tuple(
        (last - 1 - slot) // num_slots - (first - 1 - slot) // num_slots for slot in range(num_slots)
    )
