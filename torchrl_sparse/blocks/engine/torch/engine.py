"""The PyTorch engine: the reference's results in a fraction of the time, on a CPU or a GPU.

What does not change within a policy call is done before its loop: time tokens are encoded and folded once per
network, observations once per query, cross-attention reads folded memory
(:mod:`torchrl_sparse.blocks.engine.folding`), the sampler is a table, and a mask becomes a program
(:mod:`torchrl_sparse.blocks.engine.program`), built once per distinct mask.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import Overhead, check_query
from torchrl_sparse.blocks.engine.costs import folded_block_macs, folded_overhead_macs
from torchrl_sparse.blocks.engine.timing import time_blocks
from torchrl_sparse.blocks.engine.torch.graphs import padded_batch
from torchrl_sparse.blocks.engine.torch.linear import can_pack
from torchrl_sparse.blocks.engine.torch.pool import WorkspacePool
from torchrl_sparse.blocks.engine.torch.precision import weights_precision
from torchrl_sparse.blocks.engine.torch.program import build_loop
from torchrl_sparse.blocks.engine.torch.tables import Tables
from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse, num_buffers
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.frozen import Frozen

__all__ = ["TorchEngine"]


class TorchEngine:
    """Engine that runs programs in PyTorch. Not differentiable; safe to share between threads.

    The engine tabulates the network's weights, and does so again when it finds them changed
    (:class:`~torchrl_sparse.blocks.engine.weights.WeightWatch`). Dropout is never applied, and ``torch.autocast`` changes
    nothing: the engine computes in the type of the weights.

    Rows of a batch that compute a block are gathered, the block runs on them alone, its results are
    scattered; where every row agrees, as with one mask for all, nothing is. On a CUDA device blocks are
    captured as CUDA graphs, once for each power of two that a batch is padded to, and replayed for any mask.

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
        self._network, self._sampler = network, sampler
        self._watch = WeightWatch(network)
        self._known: tuple = (None, None, None)
        self._current()

    def __reduce__(self) -> tuple:
        """Let copies and pickles make tables and locks of their own."""
        return TorchEngine, (self._network, self._sampler)

    @property
    def detail(self) -> str:
        weight = self._network.head.weight
        packed = "oneDNN on packed weights" if can_pack(weight) else "general matrix products"
        return f"{weight.device.type}, {packed}"

    def denoise(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None = None,
        reuse: Reuse = "block",
        guide: Guide | None = None,
    ) -> Tensor:
        """See :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`; no gradients flow."""
        check_query(self._network, self._sampler, noise, cond, mask, reuse, guide)
        if not len(cond):
            return torch.empty_like(noise[:, 0])
        tables, pool = self._current()
        with weights_precision(tables.device):
            actions = self._denoise(tables, pool, noise, cond, mask, reuse, guide)
        return actions.clone()  # made outside of inference mode, it can be used anywhere

    def refresh(self) -> None:
        """Tabulate the weights again at the next policy call."""
        self._watch.refresh()

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_seconds`."""
        tables, pool = self._current()
        with weights_precision(tables.device), pool.take(1, self._network.num_blocks) as workspace:
            return time_blocks(workspace.walk, BLOCK_TYPES, self._network.n_layer, repeats, tables.device)

    def block_macs(self) -> tuple[int, int, int]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_macs`."""
        return folded_block_macs(self._network)

    def overhead_macs(self) -> Overhead:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.overhead_macs`."""
        return folded_overhead_macs(self._network, merged_stem=False)

    def _current(self) -> tuple[Tables, WorkspacePool]:
        """Return tables of the present weights, and the workspaces made with them."""
        state = self._watch.state()
        known, tables, pool = self._known  # read and replaced in one go: other threads may do the same
        if known != state:
            # Frozen tensors look at every operation: the tables are made of a copy's.
            network = self._network if Frozen.of(self._network) is None else copy.deepcopy(self._network)
            with weights_precision(network.pos_emb.device):
                tables = Tables(network, self._sampler)
            pool = WorkspacePool(tables)
            self._known = state, tables, pool
        return tables, pool

    def _denoise(
        self,
        tables: Tables,
        pool: WorkspacePool,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None,
        reuse: Reuse,
        guide: Guide | None,
    ) -> Tensor:
        rows, masks = len(noise), self._host_masks(mask)
        if pool.captures:
            noise, cond, masks, guide = _padded(noise, cond, masks, guide)
        loop = build_loop(masks, tables.device, gather=not pool.captures)
        slots = 0 if loop.dense else num_buffers(reuse, self._network.num_blocks)
        with pool.take(len(noise), slots, guide is not None) as workspace:
            return workspace.denoise(loop, noise, cond, guide)[:rows]

    def _host_masks(self, mask: Tensor | None) -> np.ndarray:
        """Return the masks on the host, a single one if that is that of all rows."""
        if mask is None:
            return np.zeros((1, self._sampler.num_inference_steps, self._network.num_blocks), bool)
        host = mask.cpu().numpy()
        return host[:1] if (host == host[0]).all() else host


def _padded(
    noise: Tensor, cond: Tensor, masks: np.ndarray, guide: Guide | None
) -> tuple[Tensor, Tensor, np.ndarray, Guide | None]:
    """Repeat the last row of a batch until it has a size that graphs are captured for."""
    rows = len(noise)
    index = np.minimum(np.arange(padded_batch(rows)), rows - 1)
    if len(masks) > 1:
        masks = masks[index]
    place = torch.from_numpy(index).to(noise.device)
    return noise[place], cond[place], masks, None if guide is None else guide.rows(place)
