"""The PyTorch engine, of denoisers with adaptive layer norms."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.base import Overhead, check_query
from torchrl_sparse.blocks.engine.timing import time_blocks
from torchrl_sparse.blocks.engine.torch.adaln import AdaLNTables, run_loop
from torchrl_sparse.blocks.engine.torch.linear import can_pack
from torchrl_sparse.blocks.engine.torch.precision import weights_precision
from torchrl_sparse.blocks.engine.torch.program import build_loop
from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.blocks.mask import NetworkSizes, Reuse, block_macs
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["AdaLNEngine"]


class AdaLNEngine:
    """Engine that runs programs of an `AdaLNTransformer` in PyTorch. Not differentiable; safe to share between threads.

    Weights are tabulated, and again when they are found changed
    (:class:`~torchrl_sparse.blocks.engine.weights.WeightWatch`).

    Args:
        network: the denoiser, on any device.
        sampler: the sampler.

    Examples:
        >>> network = AdaLNTransformer(input_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_head=2, n_emb=16)
        >>> engine = AdaLNEngine(network.eval(), Sampler("flow", 10))
        >>> engine.denoise(torch.randn(3, 10, 4, 7), torch.randn(3, 2, 5)).shape
        torch.Size([3, 4, 7])
    """

    name = "torch"

    def __init__(self, network: AdaLNTransformer, sampler: Sampler) -> None:
        self._network, self._sampler = network, sampler
        self._watch = WeightWatch(network)
        self._known: tuple = (None, None)
        self._current()

    def __reduce__(self) -> tuple:
        """Let copies and pickles make tables of their own."""
        return AdaLNEngine, (self._network, self._sampler)

    @property
    def detail(self) -> str:
        weight = self._network.like
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
        with weights_precision(self._network.like.device):
            tables = self._current()
            masks = torch.zeros(1, noise.shape[1], self._network.num_blocks, dtype=torch.bool)
            if mask is not None:
                host = mask.cpu()
                masks = host[:1] if (host == host[:1]).all() else host
            loop = build_loop(masks.numpy(), tables.device, gather=True)
            actions = run_loop(tables, loop, noise, cond, reuse, guide)
        return actions.clone()  # made outside of inference mode, it can be used anywhere

    def refresh(self) -> None:
        """Tabulate the weights again in the next policy call."""
        self._watch.refresh()

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_seconds`."""
        network, like = self._network, self._network.like
        types = network.block_types
        with weights_precision(like.device):
            tables = self._current()
            x, modulation = like.new_zeros(1, network.horizon, network.n_emb), tables.time[0]

            def walk(kind: int) -> None:
                for block in range(kind, network.num_blocks, len(types)):
                    tables.blocks[block](x, modulation[block][None])

            return time_blocks(walk, types, network.n_layer, repeats, like.device)

    def block_macs(self) -> tuple[int, ...]:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.block_macs`: without modulations, which a call adds up."""
        network = self._network
        modulation = 3 * network.n_emb * (network.time_dim + network.n_obs_steps * network.cond_dim)
        return tuple(macs - modulation for macs in block_macs(NetworkSizes.of(network)))

    def overhead_macs(self) -> Overhead:
        """See :meth:`~torchrl_sparse.blocks.engine.base.Engine.overhead_macs`."""
        network = self._network
        observed = network.n_obs_steps * network.cond_dim
        step = (network.input_dim + network.output_dim) * network.n_emb * network.horizon
        return Overhead(step, memory=0, query=3 * network.n_emb * network.num_blocks * observed)

    def _current(self) -> AdaLNTables:
        """Return tables of the present weights."""
        state = self._watch.state()
        known, tables = self._known  # read and replaced in one go: other threads may do the same
        if known != state:
            with weights_precision(self._network.like.device):
                tables = AdaLNTables(self._network, self._sampler)
            self._known = state, tables
        return tables
