"""Image preprocessing of OpenVLA-OFT's LIBERO evaluation, as in the authors' release (arXiv:2502.19645)."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

__all__ = ["RENDERED_SIZE", "ReleaseImages", "as_released"]

RENDERED_SIZE = 256
"""Height and width in pixels at which the release renders."""

_QUALITY = 95  # TensorFlow's default, as is the halved resolution of colours


def as_released(image: Tensor, size: int) -> Tensor:
    """Compress an image as JPEG and resize it with an antialiased Lanczos filter: u8 [3, h, w] to u8 [3, size, size].

    The checkpoints were trained on images that went that way. The release does it in TensorFlow; rounding of the filter and
    the decoder differs by a level or so.

    Examples:
        >>> grey = torch.full((3, 256, 256), 90, dtype=torch.uint8)
        >>> as_released(grey, 224).unique().tolist()
        [90]
    """
    file = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image.permute(1, 2, 0).cpu().numpy()))
    picture.save(file, "JPEG", quality=_QUALITY, subsampling="4:2:0")
    with Image.open(file) as decoded:
        scaled = decoded.resize((size, size), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(scaled)).permute(2, 0, 1).contiguous().to(image.device)


class ReleaseImages(Transform):
    """Transform that applies `as_released` to camera images, u8 [*B, 3, h, w].

    Args:
        cameras: their keys.
        size: height and width afterwards, in pixels.
    """

    def __init__(self, cameras: Sequence[NestedKey], size: int):
        super().__init__(in_keys=list(cameras), out_keys=list(cameras))
        self.size = size

    def _apply_transform(self, images: Tensor) -> Tensor:
        flat = images.reshape(-1, *images.shape[-3:])
        done = torch.stack([as_released(image, self.size) for image in flat])
        return done.reshape(*images.shape[:-2], self.size, self.size)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key in self.in_keys:
            spec = observation_spec[key]
            shape = (*spec.shape[:-2], self.size, self.size)
            observation_spec[key] = Unbounded(shape, dtype=spec.dtype, device=spec.device)
        return observation_spec
