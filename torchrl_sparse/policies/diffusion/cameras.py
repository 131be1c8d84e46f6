"""The camera encoder in use: a packed copy where that is faster and equivalent, else the module itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.networks.diffusion.packed_vision import can_pack_vision, pack_vision
from torchrl_sparse.networks.diffusion.vision import VisionEncoder

__all__ = ["CameraSlot"]


class CameraSlot:
    """Camera encoder of a policy, made on first use and again when weights change.

    Copies and pickles carry nothing.
    """

    def __init__(self) -> None:
        self._watch: WeightWatch | None = None
        self._made: dict[bool, tuple[Any, VisionEncoder]] = {}

    def get(
        self, vision: VisionEncoder, frames: int, *, bf16: bool = False
    ) -> Callable[[Mapping[str, Tensor]], Tensor]:
        """Return an encoder of ``frames`` images per camera, equal to ``vision`` up to rounding, bfloat16 included.

        It is the copy from `pack_vision` if gradients are off and no hooks watch its layers.
        """
        watched = any(module._forward_hooks or module._forward_pre_hooks for module in vision.modules())
        if (
            torch.is_grad_enabled()
            or watched
            or type(vision) is not VisionEncoder
            or not can_pack_vision(vision)
        ):
            return vision
        # Read and replaced in one go: other threads may do the same.
        watch, made = self._watch, self._made
        if watch is None or not watch.watches(vision):
            watch, made = WeightWatch(vision), {}
            self._watch, self._made = watch, made
        state = id(vision), watch.state()
        known, packed = made.get(bf16, (None, None))
        if packed is None or known != state:
            packed = pack_vision(vision, frames, bf16=bf16)
            made[bf16] = state, packed
        return packed

    def refresh(self) -> None:
        """Pack the weights again at the next policy call."""
        self._made = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_watch": None, "_made": {}}
