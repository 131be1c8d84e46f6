"""Camera encoder of Diffusion Policy's image policies (arXiv:2303.04137, section III.C.2).

Each camera has a network of its own, trained with the policy: a random crop (the centre outside of training), a
ResNet-18 (arXiv:1512.03385) whose batch norms are group norms of 16 channels, since averaged weights and
batch statistics do not go together, a spatial softmax (arXiv:1509.06113) of 32 keypoints, and a linear layer.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.sizes import check_size

__all__ = ["CameraEncoder", "VisionEncoder", "crop_centre", "crop_random", "spatial_softmax"]

_KEYPOINTS = 32
_FEATURES = 64
_CHANNELS_PER_GROUP = 16
_STRIDE = 32
_MAX_CAMERAS, _MAX_PIXELS, _MAX_WIDTH = 16, 4096, 4096


def crop_centre(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Crop the middle ``size`` (height, width) of images [N, 3, h, w].

    >>> crop_centre(torch.arange(16).view(1, 1, 4, 4), (2, 2)).flatten().tolist()
    [5, 6, 9, 10]
    """
    top, left = (round((whole - part) / 2) for whole, part in zip(images.shape[-2:], size, strict=True))
    return images[..., top : top + size[0], left : left + size[1]]


def crop_random(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Crop a ``size`` (height, width) part of each image [N, 3, h, w], each at its own random place.

    Places are drawn from torch's global generator.

    >>> crop_random(torch.zeros(5, 3, 84, 84), (76, 76)).shape
    torch.Size([5, 3, 76, 76])
    """
    places = images.unfold(-2, size[0], 1).unfold(
        -2, size[1], 1
    )  # [N, 3, tops, lefts, height, width], a view
    count = len(images)
    top, left = (torch.randint(places.shape[axis], (count,), device=images.device) for axis in (2, 3))
    return places[torch.arange(count, device=images.device), :, top, left]


def spatial_softmax(maps: Tensor) -> Tensor:
    """Return the expected position [N, K, 2] under each map's softmax, (x, y) in [-1, 1], x to the right.

    Args:
        maps: [N, K, h, w].

    >>> corner = torch.zeros(1, 1, 3, 3)
    >>> corner[0, 0, 0, 2] = 100.0
    >>> spatial_softmax(corner).tolist()
    [[[1.0, -1.0]]]
    """
    weight = maps.flatten(2).softmax(-1).view_as(maps)
    y, x = (torch.linspace(-1, 1, size, device=maps.device, dtype=maps.dtype) for size in maps.shape[-2:])
    return torch.stack([(weight.sum(2) * x).sum(-1), (weight.sum(3) * y).sum(-1)], dim=-1)


class CameraEncoder(nn.Module):
    """Encoder of one camera's images to features [N, 64].

    Args:
        crop_size: height and width of what the network sees, pixels.
        width: channels of the first stage, a multiple of 16; 64 is ResNet-18.
    """

    def __init__(self, crop_size: tuple[int, int], width: int) -> None:
        super().__init__()
        self.crop_size = crop_size
        widths = [width, 2 * width, 4 * width, 8 * width]
        self.trunk = nn.Sequential(
            nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False),
            _group_norm(width),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2, padding=1),
            _stage(width, width, stride=1),
            *(_stage(before, after, stride=2) for before, after in pairwise(widths)),
        )
        self.keypoints = nn.Conv2d(widths[-1], _KEYPOINTS, 1)
        self.linear = nn.Linear(2 * _KEYPOINTS, _FEATURES)
        for module in self.trunk.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")

    def forward(self, images: Tensor) -> Tensor:
        """Encode images u8 [N, 3, h, w]."""
        points = spatial_softmax(self.keypoints(self.trunk(self.pixels(images))))
        # robomimic, whose encoder the published policies use, ends with a rectifier.
        return self.linear(points.flatten(1)).relu()

    def pixels(self, images: Tensor) -> Tensor:
        """Return the network's input for images u8 [N, 3, h, w]: one crop of each, scaled to [-1, 1]."""
        crop = crop_random if self.training else crop_centre
        return crop(images, self.crop_size).to(self.linear.weight.dtype) / 255 * 2 - 1


class VisionEncoder(nn.Module):
    """Encoder of several cameras, one `CameraEncoder` each.

    Args:
        cameras: names of the images, ``("history", name)`` in a TensorDict; their features come in this order.
        image_size: height and width of the images, pixels.
        crop_size: height and width of the part that the networks see.
        width: channels of the first stage of the networks, a multiple of 16; 64 is ResNet-18.

    Attributes:
        feature_dim: size of the features, 64 for each camera.

    Raises:
        InputError: if a size is out of range, or a camera is named twice.

    Examples:
        >>> vision = VisionEncoder(["image"], width=16).eval()
        >>> vision({"image": torch.zeros(5, 2, 3, 84, 84, dtype=torch.uint8)}).shape
        torch.Size([5, 2, 64])
    """

    text_dim = 0  # of instructions, which it does not read

    def __init__(
        self,
        cameras: Sequence[str],
        *,
        image_size: Sequence[int] = (84, 84),
        crop_size: Sequence[int] = (76, 76),
        width: int = 64,
    ) -> None:
        super().__init__()
        self.config: dict[str, Any] = {
            "cameras": list(cameras),
            "image_size": list(image_size),
            "crop_size": list(crop_size),
            "width": width,
        }
        _check(**self.config)
        self.cameras, self.image_size = tuple(cameras), tuple(image_size)
        self.encoders = nn.ModuleDict(
            {name: CameraEncoder((crop_size[0], crop_size[1]), width) for name in cameras}
        )
        self.feature_dim = _FEATURES * len(self.cameras)

    def forward(self, images: Mapping[str, Tensor]) -> Tensor:
        """Return the features [*B, feature_dim] of images u8 [*B, 3, h, w] by camera.

        Raises:
            InputError: if images have another type or size.
        """
        return torch.cat([self._encode(name, images[name]) for name in self.cameras], dim=-1)

    def _encode(self, name: str, images: Tensor) -> Tensor:
        shape = (3, *self.image_size)
        if images.dtype != torch.uint8 or tuple(images.shape[-3:]) != shape:
            raise InputError(
                f"image {name!r}: expected uint8 [*B, {', '.join(map(str, shape))}], "
                f"got {str(images.dtype).removeprefix('torch.')} {list(images.shape)}"
            )
        features = self.encoders[name](images.reshape(-1, *shape))
        return features.reshape(*images.shape[:-3], _FEATURES)


class _Block(nn.Module):
    """ResNet's basic block: two 3x3 convolutions beside a shortcut."""

    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
        self.norm1 = _group_norm(after)
        self.conv2 = nn.Conv2d(after, after, 3, padding=1, bias=False)
        self.norm2 = _group_norm(after)
        self.downsample = None
        if stride != 1 or before != after:
            shortcut = nn.Conv2d(before, after, 1, stride=stride, bias=False)
            self.downsample = nn.Sequential(shortcut, _group_norm(after))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.norm1(self.conv1(x)).relu()
        return (self.norm2(self.conv2(x)) + shortcut).relu()


def _stage(before: int, after: int, stride: int) -> nn.Sequential:
    return nn.Sequential(_Block(before, after, stride), _Block(after, after, 1))


def _group_norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // _CHANNELS_PER_GROUP, channels)


def _check(cameras: list[str], image_size: list[int], crop_size: list[int], width: int) -> None:
    named = all(isinstance(name, str) and name and "." not in name for name in cameras)  # as modules are
    if not named or not 1 <= len(set(cameras)) == len(cameras) <= _MAX_CAMERAS:
        raise InputError(
            f"cameras: expected different names, 1 to {_MAX_CAMERAS} of them, got {reprlib.repr(cameras)}"
        )
    for size in (*image_size, *crop_size):
        check_size("image_size, crop_size", size, _MAX_PIXELS)
    if min(crop_size, default=0) <= _STRIDE:
        raise InputError(
            f"crop_size: expected more than {_STRIDE} pixels, which make a map of more than one place, got {crop_size}"
        )
    fits = len(image_size) == len(crop_size) == 2 and all(
        part <= whole for part, whole in zip(crop_size, image_size, strict=True)
    )
    if not fits:
        raise InputError(
            f"crop_size: expected height and width within image_size {image_size}, got {crop_size}"
        )
    check_size("width", width, _MAX_WIDTH)
    if width % _CHANNELS_PER_GROUP:
        raise InputError(f"width: expected a multiple of {_CHANNELS_PER_GROUP}, got {width}")
