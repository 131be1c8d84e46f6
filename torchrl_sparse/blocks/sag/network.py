"""The network of SAG's pruner: from an observation to one logit for every block of every denoising step.

What does not depend on the observation is computed once in evaluation mode, and what remains then runs in the
compiled code of :mod:`torchrl_sparse.blocks.engine.native.pruner` where that can be had.
:mod:`torchrl_sparse.blocks.sag.planner` turns logits into masks.
"""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.native.pruner import MAX_HIDDEN, NativePruner, PrunerWeights
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import MAX_TRAIN_TIMESTEPS
from torchrl_sparse.networks.diffusion.transformer import SinusoidalPosEmb
from torchrl_sparse.networks.sizes import check_size

__all__ = ["PrunerNetwork"]

# Bounds, far beyond any use, on what a file can ask for before its weights are seen: each cell of a mask takes 2 * width
# numbers that no file holds.
_MAX_CELLS, _MAX_TOKEN, _MAX_WIDTH, _MAX_LAYERS = 1 << 16, 512, 1 << 16, 64


class PrunerNetwork(nn.Module):
    """Predictor of a logit for every block of every denoising step from an encoded observation.

    In evaluation mode, what follows from the weights alone is kept until ``train()``, ``eval()``, ``load_state_dict()`` or a
    move: call ``eval()`` after writing to a weight by hand.

    Args:
        timesteps: diffusion timesteps of the sampler in execution order, K of them.
        num_blocks: blocks 3L of a denoising step.
        cond_shape: (To, D) of the encoded observations.
        width: of a coordinate's token z, a multiple of ``n_head`` and at least 4.
        obs_width: of the observation's embedding.
        hidden: of the MLP.
        n_layer, n_head: of the transformer encoder over the coordinates.
        rate_input: whether the target prune rate is an input.
        unseen: leading columns of the observations that are not read, as those of the cameras' features.

    Raises:
        InputError: if a size is no positive number or far too large, or ``width`` no multiple of ``n_head``.

    Examples:
        >>> network = PrunerNetwork([3, 2, 1, 0], num_blocks=6, cond_shape=(2, 5))
        >>> network(torch.zeros(7, 2, 5)).shape
        torch.Size([7, 4, 6, 2])
    """

    is_static = False

    def __init__(
        self,
        timesteps: Sequence[int],
        num_blocks: int,
        cond_shape: tuple[int, int],
        *,
        width: int = 64,
        obs_width: int = 64,
        hidden: int = 64,
        n_layer: int = 1,
        n_head: int = 4,
        rate_input: bool = False,
        unseen: int = 0,
    ) -> None:
        super().__init__()
        self.timesteps, self.num_blocks, self.cond_shape = list(timesteps), num_blocks, tuple(cond_shape)
        self.rate_input, self.unseen = rate_input, unseen
        self.config: dict[str, Any] = {
            "timesteps": self.timesteps,
            "num_blocks": num_blocks,
            "cond_shape": list(cond_shape),
            "width": width,
            "obs_width": obs_width,
            "hidden": hidden,
            "n_layer": n_layer,
            "n_head": n_head,
            "rate_input": self.rate_input,
        }
        _check(**self.config, unseen=unseen)
        if unseen:  # files do not name what their pruner has not
            self.config["unseen"] = unseen
        self.register_buffer("coordinates", self._coordinates(SinusoidalPosEmb(width)), persistent=False)
        self.token = nn.Linear(2 * width, width)
        layer = nn.TransformerEncoderLayer(
            width, n_head, 2 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, n_layer, enable_nested_tensor=False)
        self.obs = nn.Linear(cond_shape[0] * (cond_shape[1] - unseen) + rate_input, obs_width)
        # The first layer of the MLP on [obs ; z], as its two halves.
        self.fuse_obs = nn.Linear(obs_width, hidden)
        self.fuse_z = nn.Linear(width, hidden, bias=False)
        self.mlp = nn.Sequential(
            nn.ReLU(inplace=True),
            nn.Linear(hidden, hidden),
            nn.ReLU(inplace=True),
            nn.Linear(hidden, 2),
        )
        self._forget()

    def forward(self, cond: Tensor, rate: Tensor | None = None) -> Tensor:
        """Return logits (keep, prune) f32 [B, K, 3L, 2].

        Args:
            cond: encoded observations f32 [B, To, D].
            rate: target prune rates f32 [B, 1]; with ``rate_input``, and only then.
        """
        logits = self.mlp(self._fused(cond, rate))
        return logits.view(len(cond), len(self.timesteps), self.num_blocks, 2)

    def prune_logits(self, cond: Tensor, rate: Tensor | None = None) -> Tensor:
        """Return pruning logit minus keeping logit, f32 [B, K, 3L], at less cost than both logits.

        In evaluation mode and without gradients, compiled code computes it for float32 on the CPU.
        """
        if (native := self._compiled(cond)) is not None:
            return native.logits(self.features(cond, rate))
        _, middle, _, last = self.mlp
        hidden = functional.linear(self._fused(cond, rate).relu_(), middle.weight, middle.bias).relu_()
        logits = hidden @ (last.weight[1] - last.weight[0]) + (last.bias[1] - last.bias[0])
        return logits.view(len(cond), len(self.timesteps), self.num_blocks)

    def prune_masks(self, cond: Tensor) -> Tensor:
        """Return prune masks bool [B, K, 3L], the first step never pruned; for networks without a rate input."""
        if (native := self._compiled(cond)) is not None:
            return native.masks(cond.flatten(1))
        masks = self.prune_logits(cond) > 0
        masks[:, 0] = False
        return masks

    def _compiled(self, cond: Tensor) -> NativePruner | None:
        """Return the compiled MLP, or None where PyTorch has to compute."""
        if self.training or torch.is_grad_enabled() or not _is_f32_on_cpu(cond):
            return None
        if self._native is None and self._can_be_native():
            self._native = NativePruner(self.mlp_weights())
        return self._native

    def mlp_weights(self) -> PrunerWeights:
        """Return the weights of the observation-dependent part, for compiled code."""
        _, middle, _, last = self.mlp
        fuse, middle, last = ((layer.weight, layer.bias) for layer in (self.fuse_obs, middle, last))
        obs = self._weight_of_all(), self.obs.bias
        cells = self.cells().view(len(self.timesteps), self.num_blocks, -1)
        return PrunerWeights(obs, fuse, cells, middle, last)

    def _weight_of_all(self) -> Tensor:
        """Return the first weight with zeros for what is not read, so that compiled code takes the observation as it lies."""
        if not self.unseen:
            return self.obs.weight
        steps, size = self.cond_shape
        seen = self.obs.weight[:, : steps * (size - self.unseen)].unflatten(1, (steps, -1))
        rate = self.obs.weight[:, seen[0].numel() :]
        return torch.cat([functional.pad(seen, (self.unseen, 0)).flatten(1), rate], dim=1)

    def _can_be_native(self) -> bool:
        small = self.fuse_obs.out_features <= MAX_HIDDEN
        return small and _is_f32_on_cpu(self.obs.weight) and native_available()[0]

    def features(self, cond: Tensor, rate: Tensor | None) -> Tensor:
        """Return the input features of a policy call, f32 [B, n]."""
        return cond.flatten(1) if rate is None else torch.cat([cond.flatten(1), rate.to(cond.dtype)], dim=-1)

    def _fused(self, cond: Tensor, rate: Tensor | None) -> Tensor:
        """Return the first MLP layer's sums, one row per cell of every observation: [B * K * 3L, hidden]."""
        obs = self.fuse_obs(self.obs(self.features(cond[..., self.unseen :], rate)))
        return (obs[:, None] + self.cells()).flatten(0, 1)

    def cells(self) -> Tensor:
        """Return the cell coordinates' share of the first MLP layer, [K * 3L, hidden]; cached in evaluation mode."""
        if self.training or torch.is_grad_enabled():
            return self._encode()
        if self._cells is None:
            # Outside of autocast, which would round what is kept for calls without it.
            with torch.autocast(self.obs.weight.device.type, enabled=False):
                self._cells = self._encode()
        return self._cells

    # What is kept follows from the weights: training changes them, as do files and devices, and a copy makes its own.

    _cells: Tensor | None
    _native: NativePruner | None

    def _forget(self) -> None:
        self._cells = self._native = None

    def train(self, mode: bool = True) -> PrunerNetwork:
        self._forget()
        return super().train(mode)

    def _apply(self, fn: Any, recurse: bool = True) -> PrunerNetwork:
        self._forget()
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *args: Any) -> None:
        self._forget()
        super()._load_from_state_dict(*args)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cells": None, "_native": None}

    @property
    def macs_per_query(self) -> int:
        """Multiply-accumulates of one policy call in evaluation mode, where ``z`` is cached."""
        hidden, obs = self.fuse_obs.out_features, self.obs
        return (
            obs.in_features * obs.out_features
            + obs.out_features * hidden
            + len(self.coordinates) * (hidden * hidden + self.mlp[-1].out_features * hidden)
        )

    def _encode(self) -> Tensor:
        return self.fuse_z(self.encoder(self.token(self.coordinates)[None])[0])

    def _coordinates(self, code: SinusoidalPosEmb) -> Tensor:
        """Return [K * 3L, 2 * width], step and block codes, concatenated as in the paper, not added."""
        steps = code(torch.tensor(self.timesteps)).repeat_interleave(self.num_blocks, dim=0)
        return torch.cat([steps, code(torch.arange(self.num_blocks)).repeat(len(self.timesteps), 1)], dim=-1)


def _is_f32_on_cpu(tensor: Tensor) -> bool:
    return tensor.is_cpu and tensor.dtype == torch.float32


def _check(
    timesteps: list,
    cond_shape: list,
    num_blocks: int,
    rate_input: bool,
    unseen: int,
    **sizes: int,
) -> None:
    if len(cond_shape) != 2:
        raise InputError(f"cond_shape: expected two sizes, got {reprlib.repr(cond_shape)}")
    if not all(type(step) is int and 0 <= step < MAX_TRAIN_TIMESTEPS for step in timesteps):
        raise InputError(f"timesteps: expected diffusion timesteps, got {reprlib.repr(timesteps)}")
    if not isinstance(rate_input, bool):
        raise InputError(f"rate_input: expected true or false, got {reprlib.repr(rate_input)}")
    check_size("timesteps", len(timesteps), _MAX_CELLS)
    check_size("num_blocks", num_blocks, _MAX_CELLS // len(timesteps))
    check_size("width", sizes["width"], _MAX_TOKEN)
    check_size("n_layer", sizes["n_layer"], _MAX_LAYERS)
    for name, size in (*sizes.items(), *(("cond_shape", size) for size in cond_shape)):
        check_size(name, size, _MAX_WIDTH)
    if type(unseen) is not int or not 0 <= unseen < cond_shape[1]:
        raise InputError(f"unseen: expected 0 to {cond_shape[1] - 1} columns, got {reprlib.repr(unseen)}")
    if sizes["width"] % sizes["n_head"]:
        raise InputError(f"width: expected a multiple of n_head={sizes['n_head']}, got {sizes['width']}")
