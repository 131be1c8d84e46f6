"""The PyTorch engine: the reference's results in a fraction of its time, on a CPU or a GPU.

What does not change within a query is done before its loop: time tokens are encoded and folded once per network, observations
once per query, cross-attention reads folded memory (:mod:`torchrl_sparse.blocks.engine.folding`), the scheduler is a table,
and a mask becomes a program (:mod:`torchrl_sparse.blocks.engine.plan`), built once per distinct mask.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.graphs import GraphedQuery
from torchrl_sparse.blocks.engine.reference import check_query
from torchrl_sparse.blocks.engine.torch_blocks import Tables, can_pack
from torchrl_sparse.blocks.engine.torch_loop import build_loop, run_loop
from torchrl_sparse.blocks.mask import Reuse

if TYPE_CHECKING:
    from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
    from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["TorchEngine"]


class TorchEngine:
    """Runs programs in PyTorch; a snapshot of the network's weights. Safe to share between threads.

    Rows of a batch that compute a block are gathered, the block runs on them alone, its results are scattered; where every row
    agrees, as with one mask for all, nothing is. On a CUDA device a dense query replays one CUDA graph.

    Args:
        network: the denoiser, on any device; float32 is what it is made for, float64 works.
        schedule: the sampler.

    Attributes:
        name: ``"torch"``.
        detail: the device and the matrix product in use.

    Examples:
        >>> from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
        >>> from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> engine = TorchEngine(network, NoiseSchedule("ddim", 10))
        >>> engine.denoise(torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5)).shape
        torch.Size([3, 4, 7])
    """

    name = "torch"

    @torch.inference_mode()
    def __init__(self, network: TransformerForDiffusion, schedule: NoiseSchedule) -> None:
        self._network, self._schedule = network, schedule
        self.tables = Tables(network, schedule)
        self._graphs = GraphedQuery(self._dense) if self.tables.device.type == "cuda" else None

    @property
    def detail(self) -> str:
        device = self.tables.device.type
        packed = can_pack(self.tables.stem_weight)
        return f"{device}, {'oneDNN on packed weights' if packed else 'general matrix products'}"

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """See :meth:`torchrl_sparse.blocks.engine.base.Engine.denoise`; no gradients flow."""
        check_query(self._network, self._schedule, noise, cond, mask, reuse)
        with torch.inference_mode():
            actions = self._denoise(noise, cond, mask, reuse)
        return actions.clone()  # made outside of inference mode, it can be used anywhere

    def _denoise(self, noise: Tensor, cond: Tensor, mask: Tensor | None, reuse: Reuse) -> Tensor:
        host = None if mask is None else mask.cpu().numpy()
        if host is None or not host.any():
            return self._dense(noise, cond) if self._graphs is None else self._graphs(noise, cond)
        if (host == host[0]).all():
            host = host[:1]
        return run_loop(self.tables, build_loop(host, self.tables.device), noise, cond, reuse)

    def _dense(self, noise: Tensor, cond: Tensor) -> Tensor:
        nothing = np.zeros((1, self._schedule.num_inference_steps, self._network.num_blocks), bool)
        return run_loop(self.tables, build_loop(nothing, self.tables.device), noise, cond, reuse=None)
