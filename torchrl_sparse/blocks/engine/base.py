"""What every engine offers: one query, from its noise and its mask to the actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.costs import time_blocks
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.mask import BLOCK_TYPES, Reuse

if TYPE_CHECKING:
    from torchrl_sparse.networks.diffusion.sampler import Sampler
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["Engine", "ReferenceEngine"]


class Engine(Protocol):
    """Runs queries of one network with one sampler; made by
    :func:`torchrl_sparse.blocks.engine.make_engine`.

    An engine answers for the weights that its network has when it is asked.

    Attributes:
        name: ``"reference"``, ``"torch"`` or ``"native"``.
        detail: in a few words, what of the machine it uses.
    """

    name: str
    detail: str

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """Normalised actions f32 [B, H, A], as :func:`torchrl_sparse.blocks.engine.reference.denoise` defines
        them.

        Args:
            noise: f32 [B, K, H, A], standard normal.
            cond: f32 [B, To, D], encoded observations.
            mask: bool [B, K, 3L], True = pruned, row 0 all False; None prunes nothing.
            reuse: what a pruned block adds, ``"block"`` or ``"type"``.

        Raises:
            ValueError: naming what was expected and what came.
        """
        ...

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """Measured seconds of one block of each type, ``{"SA": ..., "CA": ..., "FFN": ...}``, batch 1."""
        ...


class ReferenceEngine:
    """The definition: eager and differentiable; reads the network's weights anew in every query.

    Args:
        network: the denoiser.
        sampler: the sampler.
    """

    name = "reference"
    detail = "eager and differentiable"

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler) -> None:
        self._network, self._schedule = network, sampler

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """See :meth:`Engine.denoise`; gradients flow."""
        return denoise(self._network, self._schedule, noise, cond, mask, reuse=reuse)

    @torch.no_grad()
    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """See :meth:`Engine.block_seconds`."""
        network, like = self._network, self._network.pos_emb
        x = network.embed(like.new_zeros(1, network.horizon, network.input_dim))
        memory = network.memory(0, like.new_zeros(1, network.n_obs_steps, network.cond_dim))

        def walk(kind: int) -> None:
            for block in range(kind, network.num_blocks, len(BLOCK_TYPES)):
                network.block(block, x, memory)

        return time_blocks(walk, network.n_layer, repeats, like.device)
