"""The denoising loop of the PyTorch engine, and its working memory.

A loop is a sequence of *segments*, and a program says which come in which order: the block of a column, for all rows of
a batch or for some, the predicted noise with the sampler's step, and a few single operations such as adding a run of
reused outputs. A segment reads and writes memory that is always the same; what differs between denoising steps is
copied there beforehand. So each can be captured once, as a CUDA graph, and a mask that was never seen is only another
order of what is there already.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.program import COLLAPSE, COMPUTE
from torchrl_sparse.blocks.engine.torch.blocks import BlockScratch
from torchrl_sparse.blocks.engine.torch.memory import Memory
from torchrl_sparse.blocks.engine.torch.program import Loop, Operation, build_loop
from torchrl_sparse.blocks.engine.torch.tables import Tables
from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.networks.diffusion.coefficients import Guide

__all__ = ["Segment", "Workspace"]

_KINDS, _CA = len(BLOCK_TYPES), BLOCK_TYPES.index("CA")

Segment = Callable[[], object]


class Workspace:
    """Buffers for the policy calls of one batch size, allocated once; for one call at a time.

    Args:
        tables: of the network.
        batch: rows B.
        slots: latest outputs to keep (:func:`~torchrl_sparse.blocks.mask.num_buffers`); 0 for dense loops, which
            reuse none.
        capture: turns a segment into one that does the same faster; None leaves them as they are. With it, the whole
            dense loop is one segment, and a block that only some rows need computes all of them and keeps those: the
            number of rows is part of a captured segment, and one for each number would be a great many.
        guided: whether every call has a guide, or none.
    """

    def __init__(
        self,
        tables: Tables,
        batch: int,
        slots: int,
        capture: Callable[[Segment], Segment] | None = None,
        *,
        guided: bool = False,
    ) -> None:
        network, new = tables.network, tables.stem_weight.new_zeros
        rows, width = batch * network.horizon, network.n_emb
        self._tables, self._batch = tables, batch
        self._memory, self._scratch = Memory(tables, batch), BlockScratch(network, batch)
        self._parts: dict[int, _Part] = {}
        self._sample, self._clean, self._eps, *self._earlier = new(
            3 + tables.history, rows, network.input_dim
        ).unbind(0)
        self._guide = Guide(torch.empty_like(self._sample), new(rows, 1)) if guided else None
        self._step_table = new(tables.num_steps, tables.coefficients.shape[1] + self._sample.numel())
        self._step_table[:, : tables.coefficients.shape[1]] = tables.coefficients
        self._step_row = torch.empty_like(self._step_table[0])
        coefficients, gaussian = self._step_row.tensor_split([tables.coefficients.shape[1]])
        self._coefficients, self._gaussian = coefficients.unbind(0), gaussian.view_as(self._sample)
        self._stem = tables.stem_bias.repeat(batch, 1)
        self._x, self._sum = new(2, rows, width).unbind(0)
        self._chosen = torch.zeros(batch, 1, dtype=torch.bool, device=tables.device)
        self._keeps = slots > 0
        self._latest = new(slots, rows, width)
        blocks = range(network.num_blocks)
        self._slots = [self._latest[b % slots] if slots else self._scratch.output for b in blocks]
        self._reads = [self._memory.by_layer[b // _KINDS] if b % _KINDS == _CA else () for b in blocks]
        self._ones = new(network.num_blocks) + 1
        self._runs: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
        self._set_segments(capture)

    def _set_segments(self, capture: Callable[[Segment], Segment] | None) -> None:
        blocks = range(len(self._tables.blocks))
        self._compute: list[Segment] = [partial(self._compute_all, block) for block in blocks]
        self._choose: list[Segment] = [partial(self._compute_chosen, block) for block in blocks]
        self._finish: Segment = self._finish_step
        self._fold: Segment = self._memory.fold
        self._play: Callable[[Loop], object] = self._run
        self._gathers = capture is None
        if capture is None:
            return
        if not self._keeps:
            dense = np.zeros((1, self._tables.num_steps, len(blocks)), bool)
            whole = capture(partial(self._run, build_loop(dense, self._tables.device, gather=False)))
            self._play = lambda loop: whole()
            return
        self._compute = [capture(segment) for segment in self._compute]
        if self._batch > 1:
            self._choose = [capture(segment) for segment in self._choose]
        self._finish = capture(self._finish)
        if self._tables.time is None:
            self._fold = capture(self._fold)

    def denoise(self, loop: Loop, noise: Tensor, cond: Tensor, guide: Guide | None = None) -> Tensor:
        """Return the actions [B, H, A] of one policy call, see :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`."""
        self._sample.copy_(noise[:, 0].flatten(0, 1))
        if guide is not None:
            assert self._guide is not None  # a guided policy call is given a guided workspace
            for part, given in zip(self._guide, guide, strict=True):
                part.copy_(given.flatten(0, 1))
        for earlier in self._earlier:
            earlier.zero_()
        # What step k adds is the gaussian of the transition to step k + 1; the last step adds none.
        gaussians = noise[:, 1:].transpose(0, 1)
        target = self._step_table[:-1, len(self._coefficients) :].view(gaussians.shape)
        torch.mul(gaussians, self._tables.spread[:-1, None, None, None], out=target)
        self._memory.begin(cond)
        self._play(loop)
        return self._sample.view(noise[:, 0].shape).clone()

    def walk(self, kind: int) -> None:
        """Run the blocks of type ``kind`` (an index of ``BLOCK_TYPES``) of all layers, for timing."""
        for segment in self._compute[kind::_KINDS]:
            segment()

    def _run(self, loop: Loop) -> None:
        for step, ops in enumerate(loop.steps):
            self._step_row.copy_(self._step_table[step])
            if loop.attends[step]:
                self._memory.load(step)
                if self._tables.time is None:
                    self._fold()
            if ops[0][0] == COLLAPSE:
                self._embed_collapsed(fresh=ops[0][1])
            else:
                self._embed(self._stem)
                self._walk(ops)
            self._finish()

    def _walk(self, ops: list[Operation]) -> None:
        for op, first, last, rows in ops:
            if op != COMPUTE:
                self._add_reused(self._x, first, last)
            elif rows is None:
                self._compute[first]()
            elif self._gathers:
                self._compute_gathered(first, rows)
            else:
                self._chosen.copy_(rows)
                self._choose[first]()

    def _embed(self, bias: Tensor) -> None:
        torch.addmm(bias, self._sample, self._tables.stem_weight, out=self._x)

    def _embed_collapsed(self, fresh: int) -> None:
        if fresh:
            self._sum.copy_(self._stem)
            self._add_reused(self._sum, 0, len(self._tables.blocks))
        self._embed(self._sum)

    def _compute_all(self, block: int) -> None:
        slot = self._slots[block]
        added = self._tables.blocks[block](self._x, slot, self._scratch, *self._reads[block])
        self._x.add_(added)
        if self._keeps and added is not slot:
            slot.copy_(added)

    def _compute_chosen(self, block: int) -> None:
        """Compute ``block`` for the rows that ``_chosen`` names."""
        scratch, slot = self._scratch, self._slots[block]
        added = self._tables.blocks[block](self._x, scratch.output, scratch, *self._reads[block])
        latest = slot.view(self._batch, -1)
        torch.where(self._chosen, added.view(latest.shape), latest, out=latest)
        self._x.add_(slot)

    def _compute_gathered(self, block: int, rows: list[int]) -> None:
        """Compute ``block`` for ``rows`` alone."""
        part = self._parts.get(len(rows))
        if part is None:
            part = self._parts[len(rows)] = _Part(self._tables, self._memory, len(rows))
        slot, reads = self._slots[block], self._reads[block]
        sources = [self._x.view(self._batch, -1), *reads]
        for source, target in zip(sources, part.inputs, strict=False):
            for row, place in zip(rows, target, strict=True):
                place.copy_(source[row])
        added = self._tables.blocks[block](
            part.x, part.scratch.output, part.scratch, *part.memory[: len(reads)]
        )
        latest = slot.view(self._batch, -1)
        for row, values in zip(rows, added.view(len(rows), -1), strict=True):
            latest[row].copy_(values)
        self._x.add_(slot)

    def _add_reused(self, to: Tensor, first: int, last: int) -> None:
        """Add to ``to`` what the pruned blocks ``first .. last-1`` add: one matrix times one vector."""
        run = self._runs.get((first, last))
        if run is None:
            latest = self._latest.flatten(1)
            counts = self._tables.counts.get(len(latest))  # None where every block has a slot of its own
            run = latest[first:last].mT, self._ones[: last - first]
            if counts is not None:
                run = latest.mT, counts[first][last]
            self._runs[first, last] = run
        to.view(-1).addmv_(*run)

    def _finish_step(self) -> None:
        """Predict the noise and take the sampler's step (``StepCoefficients.update`` says what it computes)."""
        tables, sample, clean = self._tables, self._sample, self._clean
        noise_scale, signal_scale, clean_weight, sample_weight, eps_weight, *weights = self._coefficients
        eps = torch.addmm(
            tables.head_bias, self._scratch.normalise(self._x), tables.head_weight, out=self._eps
        )
        if tables.sample_share:
            torch.addcmul(sample, eps, noise_scale, out=clean)
        else:
            torch.mul(eps, noise_scale, out=clean)
        clean.div_(signal_scale).clamp_(-tables.clip, tables.clip)
        if self._guide is not None:
            clean.addcmul_(self._guide.actions - clean, self._guide.pull)
        torch.addcmul(self._gaussian, sample, sample_weight, out=sample)
        sample.addcmul_(clean, clean_weight)
        if tables.weighs_eps:
            sample.addcmul_(eps, eps_weight)
        for earlier, weight in zip(self._earlier, weights, strict=False):
            sample.addcmul_(earlier, weight)
        for newer, older in reversed(list(pairwise([clean, *self._earlier]))):
            older.copy_(newer)


class _Part:
    """Memory for a block that ``size`` rows of a batch compute alone."""

    def __init__(self, tables: Tables, memory: Memory, size: int) -> None:
        network = tables.network
        self.scratch = BlockScratch(network, size)
        self.x = tables.stem_weight.new_empty(size * network.horizon, network.n_emb)
        self.memory = [source.new_empty(size, *source.shape[1:]) for source in memory.by_layer[0]]
        # By row: the residual stream, and what cross-attention reads.
        self.inputs = [part.unbind(0) for part in (self.x.view(size, -1), *self.memory)]
