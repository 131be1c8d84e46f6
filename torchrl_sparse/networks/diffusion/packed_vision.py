"""The camera encoder for fast CPU inference: the same layers with weights packed once for oneDNN.

A few frames are little work for 22 million weights, and PyTorch lays each convolution's weights out again in every call. Here
that is done when the encoder is packed, and activations stay in the order that those weights are for (channels last). They can
also be rounded to bfloat16, weights and activations, which changes the features and is faster still where the processor
multiplies bfloat16.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from torchrl_sparse.networks.diffusion.vision import VisionEncoder

__all__ = ["can_pack_vision", "pack_vision"]


def can_pack_vision(vision: VisionEncoder) -> bool:
    """Return whether ``vision`` can be packed: in eval mode, float32, on a CPU, in a PyTorch built with oneDNN."""
    available = torch.backends.mkldnn.is_available() and hasattr(
        torch.ops.mkldnn, "_reorder_convolution_weight"
    )
    floats = all(p.device.type == "cpu" and p.dtype == torch.float32 for p in vision.parameters())
    return available and floats and not vision.training


@torch.no_grad()
def pack_vision(vision: VisionEncoder, frames: int, *, bf16: bool = False) -> VisionEncoder:
    """Return a copy of ``vision`` with its current weights packed; features differ only by rounding.

    Args:
        vision: one that `can_pack_vision`.
        frames: of each camera at a time that the weights are laid out for; any other number serves too.
        bf16: whether the layers before the keypoints round weights and activations to bfloat16; where the processor cannot
            multiply these, they are multiplied as float32.

    Examples:
        >>> vision = VisionEncoder(["image"], width=16).eval()
        >>> frames = {"image": torch.randint(256, (2, 3, 84, 84), dtype=torch.uint8)}
        >>> with torch.no_grad():
        ...     packed = pack_vision(vision, frames=2)(frames)
        ...     torch.allclose(packed, vision(frames), atol=1e-5)
        True
    """
    packed = copy.deepcopy(vision).requires_grad_(False)
    if bf16:
        for encoder in packed.encoders.values():
            encoder.trunk.bfloat16()
    for module in list(packed.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, nn.Conv2d):
                setattr(module, name, _PackedConvolution(child))
    shape = (frames, 3, *vision.image_size)
    packed({name: torch.zeros(shape, dtype=torch.uint8) for name in vision.cameras})
    return packed


class _PackedConvolution(nn.Module):
    """One of the encoder's convolutions, whose weights are laid out in its first call, for the size that it then sees."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        super().__init__()
        self._convolution: nn.Conv2d | None = convolution
        self._dtype = convolution.weight.dtype
        # oneDNN refuses to multiply bfloat16 where the processor has no instructions that it takes for that.
        multiplies = self._dtype != torch.bfloat16 or torch.ops.mkldnn._is_mkldnn_bf16_supported()
        self._multiplied = self._dtype if multiplies else torch.float32
        self._bias = None if convolution.bias is None else convolution.bias.to(self._multiplied)
        sizes = convolution.padding, convolution.stride, convolution.dilation
        self._sizes = (*map(list, sizes), convolution.groups)

    def forward(self, x: Tensor) -> Tensor:
        x = x.to(self._dtype).to(self._multiplied, memory_format=torch.channels_last)
        if self._convolution is not None:
            weight = self._convolution.weight.detach().to(self._multiplied)
            self._weight = torch.ops.mkldnn._reorder_convolution_weight(weight, *self._sizes, list(x.shape))
            self._convolution = None
        # "none": no activation behind it, a norm comes first
        return torch.ops.mkldnn._convolution_pointwise(
            x, self._weight, self._bias, *self._sizes, "none", [], ""
        ).to(self._dtype)
