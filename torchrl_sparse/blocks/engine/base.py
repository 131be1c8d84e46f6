"""What every engine offers: one query, from its noise and its mask to the actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from torchrl_sparse.blocks.engine.reference import check_query, denoise
from torchrl_sparse.blocks.mask import Reuse

if TYPE_CHECKING:
    from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
    from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["Engine", "ReferenceEngine", "check_query"]


class Engine(Protocol):
    """Runs queries of one network with one schedule; made by :func:`torchrl_sparse.blocks.engine.make_engine`.

    All but the reference tabulate the weights when they are made: an engine answers for the network as it was then.

    Attributes:
        name: ``"reference"``, ``"torch"`` or ``"native"``.
        detail: in a few words, what of the machine it uses.
    """

    name: str
    detail: str

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """Normalised actions f32 [B, H, A], as :func:`torchrl_sparse.blocks.engine.reference.denoise` defines them.

        Args:
            noise: f32 [B, K, H, A], standard normal.
            cond: f32 [B, To, D], encoded observations.
            mask: bool [B, K, 3L], True = pruned, row 0 all False; None prunes nothing.
            reuse: what a pruned block adds, ``"block"`` or ``"type"``.

        Raises:
            ValueError: naming what was expected and what came.
        """
        ...


class ReferenceEngine:
    """The definition: eager and differentiable; reads the network's weights anew in every query.

    Args:
        network: the denoiser.
        schedule: the sampler.
    """

    name = "reference"
    detail = "eager and differentiable"

    def __init__(self, network: TransformerForDiffusion, schedule: NoiseSchedule) -> None:
        self._network, self._schedule = network, schedule

    def denoise(
        self, noise: Tensor, cond: Tensor, mask: Tensor | None = None, reuse: Reuse = "block"
    ) -> Tensor:
        """See :meth:`Engine.denoise`; gradients flow."""
        return denoise(self._network, self._schedule, noise, cond, mask, reuse=reuse)
