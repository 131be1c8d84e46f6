"""The denoising loop of the PyTorch engine: programs, their rows, and the state of one query."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.folding import FoldedMemory
from torchrl_sparse.blocks.engine.plan import COLLAPSE, COMPUTE, build_program
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, num_buffers

if TYPE_CHECKING:
    from torchrl_sparse.blocks.engine.torch_blocks import Tables

__all__ = ["Loop", "build_loop", "make_walk", "run_loop"]

_CA = BLOCK_TYPES.index("CA")


@dataclass(frozen=True, eq=False)
class Loop:
    """The program of a batch; compares by identity.

    Attributes:
        steps: for each denoising step its operations (operation, first, last, rows), see
            :mod:`torchrl_sparse.blocks.engine.plan`; ``rows`` i64 names the rows of the batch that compute a
            block, None means all.
        attends: for each denoising step, whether it computes cross-attention anywhere.
        dense: nothing is ever reused.
    """

    steps: list[list[tuple[int, int, int, Tensor | None]]]
    attends: list[bool]
    dense: bool


def build_loop(masks: np.ndarray, device: torch.device) -> Loop:
    """The loop of the masks bool [B, K, 3L] of a batch, kept for the next batch with the same masks."""
    return _build_loop(masks.shape, masks.tobytes(), device)


@lru_cache(maxsize=64)
def _build_loop(shape: tuple[int, ...], data: bytes, device: torch.device) -> Loop:
    masks = np.frombuffer(data, bool).reshape(shape)
    pruned_by_all = masks.all(axis=0)
    # Where some row computes, the operation is a COMPUTE of those rows.
    program = build_program(pruned_by_all)
    rows = _partial_rows(masks, pruned_by_all, device)
    steps = [
        [
            (op, first, last, rows.get((k, first)) if op == COMPUTE else None)
            for op, first, last in program.step(k)
        ]
        for k in range(shape[1])
    ]
    attends = (~pruned_by_all[:, _CA :: len(BLOCK_TYPES)]).any(axis=1).tolist()
    return Loop(steps, attends, dense=not masks.any())


def _partial_rows(masks: np.ndarray, pruned_by_all: np.ndarray, device: torch.device) -> dict:
    """(step, block) -> i64 rows, wherever some rows compute a block and others do not."""
    cells = np.argwhere(masks.any(axis=0) & ~pruned_by_all)
    if not len(cells):
        return {}
    computed = ~masks[:, cells[:, 0], cells[:, 1]].T
    rows = torch.from_numpy(np.nonzero(computed)[1]).to(device)
    parts = rows.split(computed.sum(axis=1).tolist())
    return dict(zip(map(tuple, cells.tolist()), parts, strict=True))


def run_loop(tables: Tables, loop: Loop, noise: Tensor, cond: Tensor, reuse: Reuse) -> Tensor:
    """Actions [B, H, A] of one query.

    Buffers are allocated once per query; in its steps only PyTorch's operators allocate, what they return.
    """
    return _Query(tables, loop, noise, cond, reuse).run()


def make_walk(tables: Tables) -> Callable[[int], None]:
    """A function to be timed, which runs the SA (0), CA (1) or FFN (2) blocks of all layers, batch 1."""
    memory = _Memory(tables, tables.stem_weight.new_zeros(1, *tables.cond_shape))
    memory.set_step(0)
    x = tables.stem_bias

    def walk(kind: int) -> None:
        for layer, block in enumerate(tables.blocks[kind :: len(BLOCK_TYPES)]):
            block(x, *(memory.by_layer[layer] if kind == _CA else ()))

    return walk


class _Memory:
    """Folded memory of the denoising step at hand, for every row of the batch."""

    def __init__(self, tables: Tables, cond: Tensor) -> None:
        batch, tokens, heads = len(cond), 1 + cond.shape[1], tables.num_heads
        self._fold, self._time = tables.fold, tables.time
        self._vectors = cond.new_empty(tables.num_layers, 2, batch, tokens, heads, tables.width)
        self._bias = cond.new_zeros(tables.num_layers, batch, tables.horizon, tokens, heads)
        if tables.memory_mask is not None:
            self._bias += tables.memory_mask[..., None]
        self._hidden = self._bias[:1].clone()
        if self._time is None:
            self._memory = tables.encoder.memory(cond)
        else:
            observations = self._fold(tables.encoder.observation_tokens(cond).flatten(0, 1))
            self._put(slice(1, None), observations, batch)
        self.by_layer = [
            (vectors[0].flatten(1, 2), vectors[1].flatten(1, 2), bias.flatten(2))
            for vectors, bias in zip(self._vectors, self._bias, strict=True)
        ]

    def set_step(self, step: int) -> None:
        """Make it the memory of denoising step ``step``."""
        if self._time is None:
            self._put(slice(None), self._fold(self._memory[step].flatten(0, 1)), len(self._memory[step]))
        else:
            # Every row sees the time token, so its bias has no -inf to keep.
            self._vectors[:, :, :, 0] = self._time.vectors[:, :, step, None]
            self._bias[:, :, :, 0] = self._time.bias[:, step, None, None]

    def _put(self, tokens: slice, folded: FoldedMemory, batch: int) -> None:
        self._vectors[:, :, :, tokens] = folded.vectors.unflatten(2, (batch, -1))
        bias = folded.bias.unflatten(1, (batch, 1, -1))
        torch.add(self._hidden[:, :, :, tokens], bias, out=self._bias[:, :, :, tokens])


class _Query:
    """The state of one query."""

    def __init__(self, tables: Tables, loop: Loop, noise: Tensor, cond: Tensor, reuse: Reuse) -> None:
        self._tables, self._loop = tables, loop
        self._batch = batch = len(noise)
        rows, size = batch * tables.horizon, batch * tables.horizon * tables.width
        self._sample = noise[:, 0].reshape(rows, -1).clone()
        self._clean = torch.empty_like(self._sample)
        self._gaussians = _scaled_gaussians(noise, tables.spread)
        self._memory = _Memory(tables, cond)
        self._stem = tables.stem_bias.repeat(batch, 1)
        self._x = noise.new_empty(rows, tables.width)
        self._sum = torch.empty_like(self._x)
        slots = num_buffers(reuse, tables.num_blocks)
        self._counts = tables.counts.get(slots)  # None where every block has a buffer of its own
        self._latest = None if loop.dense else noise.new_empty(slots, size)
        self._slots = None if loop.dense else [slot.view(rows, -1) for slot in self._latest]
        self._ones = noise.new_ones(tables.num_blocks)

    def run(self) -> Tensor:
        """Actions [B, H, A]."""
        for step, ops in enumerate(self._loop.steps):
            if self._loop.attends[step]:
                self._memory.set_step(step)
            self._update(step, self._predict(ops))
        return self._sample.view(self._batch, self._tables.horizon, -1)

    def _predict(self, ops: list[tuple[int, int, int, Tensor | None]]) -> Tensor:
        """The noise [B * H, A] that the network predicts."""
        tables, x = self._tables, self._x
        if ops[0][0] == COLLAPSE:
            if ops[0][1]:
                self._sum.copy_(self._stem)
                self._add_reused(self._sum, 0, tables.num_blocks)
            torch.addmm(self._sum, self._sample, tables.stem_weight, out=x)
        else:
            torch.addmm(self._stem, self._sample, tables.stem_weight, out=x)
            for op, first, last, rows in ops:
                if op == COMPUTE:
                    self._compute(first, rows)
                else:
                    self._add_reused(x, first, last)
        return torch.addmm(tables.head_bias, tables.norm(x), tables.head_weight)

    def _compute(self, block: int, rows: Tensor | None) -> None:
        x = self._x
        if rows is not None:
            self._compute_rows(block, rows)
            return
        output = self._tables.blocks[block](x, *self._block_memory(block))
        x.add_(output)
        if self._slots is not None:
            self._slot(block).copy_(output)

    def _compute_rows(self, block: int, rows: Tensor) -> None:
        shape = (self._batch, -1)
        memory = [part.index_select(0, rows) for part in self._block_memory(block)]
        x = self._x.view(shape).index_select(0, rows).view(-1, self._tables.width)
        output = self._tables.blocks[block](x, *memory)
        latest = self._slot(block)
        latest.view(shape).index_copy_(0, rows, output.view(len(rows), -1))
        self._x.add_(latest)

    def _block_memory(self, block: int) -> tuple[Tensor, ...]:
        layer, kind = divmod(block, len(BLOCK_TYPES))
        return self._memory.by_layer[layer] if kind == _CA else ()

    def _slot(self, block: int) -> Tensor:
        return self._slots[block % len(self._slots)]

    def _add_reused(self, x: Tensor, first: int, last: int) -> None:
        """Add to ``x`` what the pruned blocks ``first .. last-1`` add: one matrix times one vector."""
        if self._counts is not None:
            x.view(-1).addmv_(self._latest.mT, self._counts[first][last])
        else:
            x.view(-1).addmv_(self._latest[first:last].mT, self._ones[: last - first])

    def _update(self, step: int, eps: Tensor) -> None:
        """Take the scheduler's step, in place (:meth:`StepCoefficients.update` says what it computes)."""
        noise_scale, signal_scale, clean_weight, sample_weight, eps_weight = self._tables.updates[step]
        sample, clip = self._sample, self._tables.clip
        clean = torch.sub(sample, eps, alpha=noise_scale, out=self._clean)
        clean.div_(signal_scale).clamp_(-clip, clip)
        torch.add(self._gaussians[step], sample, alpha=sample_weight, out=sample)
        sample.add_(clean, alpha=clean_weight)
        if eps_weight:
            sample.add_(eps, alpha=eps_weight)


def _scaled_gaussians(noise: Tensor, spread: Tensor) -> tuple[Tensor, ...]:
    """What each of the K steps adds, [B * H, A]."""
    # The last step's spread is 0, and there is no gaussian for it: any will do.
    scaled = noise.roll(-1, dims=1) * spread[:, None, None]
    return scaled.transpose(0, 1).flatten(1, 2).unbind(0)
