"""The PyTorch engine: the reference's results in a fraction of its time, on a CPU or a GPU.

What does not change within a query is done before its loop: time tokens are encoded and folded once per
network, observations once per query, cross-attention reads folded memory
(:mod:`torchrl_sparse.blocks.engine.folding`), the sampler is a table, and a mask becomes a program
(:mod:`torchrl_sparse.blocks.engine.program`), built once per distinct mask.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.costs import time_blocks
from torchrl_sparse.blocks.engine.reference import check_query
from torchrl_sparse.blocks.engine.torch.graphs import GraphCapture
from torchrl_sparse.blocks.engine.torch.linear import can_pack
from torchrl_sparse.blocks.engine.torch.loop import Workspace
from torchrl_sparse.blocks.engine.torch.program import build_loop
from torchrl_sparse.blocks.engine.torch.tables import Tables
from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.blocks.mask import Reuse, num_buffers

if TYPE_CHECKING:
    from torchrl_sparse.networks.diffusion.sampler import Sampler
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["TorchEngine"]


class TorchEngine:
    """Runs programs in PyTorch. Not differentiable; safe to share between threads.

    The engine tabulates the network's weights, and does so again when it finds them changed
    (:class:`~torchrl_sparse.blocks.engine.weights.WeightWatch`). Dropout is never applied.

    Rows of a batch that compute a block are gathered, the block runs on them alone, its results are
    scattered; where every row agrees, as with one mask for all, nothing is. On a CUDA device a query
    whose masks came before replays a CUDA graph of its own.

    Args:
        network: the denoiser, on any device; float32 is what it is made for, float64 works.
        sampler: the sampler.

    Attributes:
        name: ``"torch"``.
        detail: the device and the matrix product in use.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> engine = TorchEngine(network, Sampler("ddim", 10))
        >>> engine.denoise(torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5)).shape
        torch.Size([3, 4, 7])
    """

    name = "torch"

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler) -> None:
        self._network, self._schedule = network, sampler
        self._watch = WeightWatch(network)
        self._known: tuple = (None, None, None)
        self._current()

    @property
    def detail(self) -> str:
        weight = self._network.head.weight
        packed = "oneDNN on packed weights" if can_pack(weight) else "general matrix products"
        return f"{weight.device.type}, {packed}"

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """See :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`; no gradients flow."""
        check_query(self._network, self._schedule, noise, cond, mask, reuse)
        with torch.inference_mode():
            actions = self._denoise(noise, cond, mask, reuse)
        return actions.clone()  # made outside of inference mode, it can be used anywhere

    @torch.inference_mode()
    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`torchrl_sparse.blocks.engine.base.Engine.block_seconds`."""
        tables, pool = self._current()
        with pool.take(1, self._network.num_blocks) as workspace:
            return time_blocks(workspace.walk, self._network.n_layer, repeats, tables.device)

    def _current(self) -> tuple[Tables, WorkspacePool]:
        """Tables of the present weights, and the workspaces made with them."""
        state = self._watch.state()
        known, tables, pool = self._known  # read and replaced in one go: other threads may do the same
        if known != state:
            with torch.inference_mode():
                tables = Tables(self._network, self._schedule)
            pool = WorkspacePool(tables)
            self._known = state, tables, pool
        return tables, pool

    def _denoise(self, noise: Tensor, cond: Tensor, mask: Tensor | None, reuse: Reuse) -> Tensor:
        tables, pool = self._current()
        loop = build_loop(self._host_masks(mask), tables.device, gather=pool.capture is None)
        slots = 0 if loop.dense else num_buffers(reuse, self._network.num_blocks)
        with pool.take(len(noise), slots) as workspace:
            return workspace.denoise(loop, noise, cond)

    def _host_masks(self, mask: Tensor | None) -> np.ndarray:
        """The masks on the host, a single one if that is that of all rows."""
        if mask is None:
            return np.zeros((1, self._schedule.num_inference_steps, self._network.num_blocks), bool)
        host = mask.cpu().numpy()
        return host[:1] if (host == host[0]).all() else host


class WorkspacePool:
    """Workspaces that wait for their next query; a query that finds none gets a new one.

    Args:
        tables: of the network.
        capacity: how many may wait; the least recently used goes first.

    Attributes:
        capture: makes a CUDA graph of a segment; None leaves segments as they are.
    """

    def __init__(self, tables: Tables, capacity: int = 8) -> None:
        self._tables, self._capacity = tables, capacity
        self._free: list[tuple[tuple, Workspace]] = []
        self._lock = threading.Lock()
        self.capture = GraphCapture(tables.device) if tables.device.type == "cuda" else None

    @contextmanager
    def take(self, batch: int, slots: int) -> Iterator[Workspace]:
        """A workspace for ``batch`` rows and ``slots`` latest outputs, for the caller alone."""
        # On a GPU the next query may be launched before the last one has run, but in the same order only in one stream.
        stream = (
            torch.cuda.current_stream(self._tables.device) if self._tables.device.type == "cuda" else None
        )
        key = (batch, slots, stream)
        with self._lock:
            index = next((i for i, (known, _) in enumerate(self._free) if known == key), None)
            workspace = None if index is None else self._free.pop(index)[1]
        if workspace is None:
            workspace = Workspace(self._tables, batch, slots, self.capture)
        yield workspace
        with self._lock:
            self._free.append((key, workspace))
            del self._free[: -self._capacity]
