"""What engines and planners know of a denoiser, whatever its shape.

A denoiser predicts noise (or the clean chunk, or a velocity) from a noisy chunk, a timestep and the last observations. Its
trunk is a residual stream to which *blocks* add, in a fixed order: layer by layer, in each layer one block of each type.
What a block reads beside the stream is its *memory*, which the timestep and the observations decide::

    x = embed(sample)
    memory = memory(timestep, cond)
    x = x + block(b, x, memory)          for every block b
    prediction = head_out(x)

=========================== =========================================== =============================================
of the memory               `TransformerForDiffusion`                   `AdaLNTransformer`
=========================== =========================================== =============================================
one per                     query: 1 + To tokens                        layer: shift, scale and gate of each block
of the timestep alone       the first token                             a summand, ``time_modulation``
of the observations alone   the others                                  a summand, ``observation_modulation``
of both                     all, if the condition encoder attends       nothing
=========================== =========================================== =============================================
"""

from __future__ import annotations

from operator import attrgetter
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError

__all__ = ["ALL_BLOCK_TYPES", "BLOCK_TYPES", "Denoiser"]

BLOCK_TYPES = ("SA", "CA", "FFN")
"""Of the published transformer: self-attention, cross-attention and feed-forward, in this order in each layer."""

ALL_BLOCK_TYPES = (BLOCK_TYPES, ("SA", "FFN"))
"""Of every denoiser that there is."""


class Denoiser(nn.Module):
    """Base of the networks that a denoising loop calls.

    Attributes:
        block_types: the blocks of a layer, in order; block ``len(block_types) * layer + i`` is of type i.
        n_layer, num_blocks: layers L, and blocks of all of them.
        horizon, input_dim, output_dim: actions in a chunk H, size of a noisy action and of a prediction.
        n_obs_steps, cond_dim: observations To, and size of one that is encoded.
        n_emb, n_head: width, attention heads.
        config: the constructor's arguments.
        made_shapes: of its weights by name, as it was made with them.
    """

    block_types: ClassVar[tuple[str, ...]]
    n_layer: int
    num_blocks: int
    horizon: int
    input_dim: int
    output_dim: int
    n_obs_steps: int
    cond_dim: int
    n_emb: int
    n_head: int
    config: dict[str, Any]
    made_shapes: dict[str, tuple[int, ...]]

    @property
    def like(self) -> nn.Parameter:
        """A weight, whose type and device are the network's."""
        raise NotImplementedError

    def embed(self, sample: Tensor) -> Tensor:
        """Embed noisy actions [B, H, input_dim] as tokens [B, H, n_emb]."""
        raise NotImplementedError

    def memory(self, timestep: float | Tensor, cond: Tensor) -> Tensor:
        """Return what blocks read beside the stream, a row for each of ``cond`` [B, To, cond_dim]."""
        raise NotImplementedError

    def block(self, index: int, x: Tensor, memory: Tensor) -> Tensor:
        """Compute what block ``index`` adds to the stream ``x`` [B, H, n_emb]; it is *not* added here."""
        raise NotImplementedError

    def head_out(self, x: Tensor) -> Tensor:
        """Project the stream [B, H, n_emb] to a prediction [B, H, output_dim]."""
        raise NotImplementedError

    def forward(self, sample: Tensor, timestep: float | Tensor, cond: Tensor) -> Tensor:
        """Predict, [B, H, output_dim].

        Args:
            sample: noisy actions [B, H, input_dim].
            timestep: a number, or a tensor [B].
            cond: encoded observations [B, To, cond_dim].
        """
        x = self.embed(sample)
        memory = self.memory(timestep, cond)
        for index in range(self.num_blocks):
            x = x + self.block(index, x, memory)
        return self.head_out(x)

    def present_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes that its weights have now, which others may have put there; see ``made_shapes``."""
        return {name: tuple(attrgetter(name)(self).shape) for name in self.made_shapes}

    def _finish(self) -> None:
        """Note what follows from the layers; called when all weights are there."""
        self.num_blocks = len(self.block_types) * self.n_layer
        self.made_shapes = {name: tuple(weight.shape) for name, weight in self.named_parameters()}

    @staticmethod
    def _check(name: str, value: Tensor, trailing: tuple[int, int]) -> None:
        if value.ndim != 3 or tuple(value.shape[1:]) != trailing:
            raise InputError(
                f"{name}: expected shape [B, {trailing[0]}, {trailing[1]}], got {list(value.shape)}"
            )

    @staticmethod
    def _timesteps(timestep: float | Tensor, cond: Tensor) -> Tensor:
        """Return the timestep of each row of ``cond``, [B]."""
        timestep = torch.as_tensor(timestep, device=cond.device)
        if timestep.shape not in ((), (1,), (cond.shape[0],)):
            raise InputError(
                f"timestep: expected a number or shape [{cond.shape[0]}], got {list(timestep.shape)}"
            )
        return timestep.expand(cond.shape[0])
