"""Cameras of a published image policy: observation layout, and robomimic's encoder as a `VisionEncoder`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.storage.published.config import PublishedConfig
from torchrl_sparse.storage.published.network import read_tensors
from torchrl_sparse.storage.published.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.storage.tensors import check_shapes, shapes_of, take

__all__ = ["ImageLayout", "read_vision"]

_FEATURES, _DEFAULT_CROP = 64, (76, 76)
_HAND = "eye_in_hand"
_RENAMED = ((r"^nets\.0\.nets\.", "trunk."), (r"^nets\.1\.nets\.", "keypoints."), (r"^nets\.3\.", "linear."))


@dataclass(frozen=True)
class ImageLayout:
    """Observation layout of a published image policy.

    Attributes:
        order: robomimic's name -> size in the condition, in the published order.
        cameras: name of the image here -> robomimic's name, in the published order. The first camera that is
            on no hand is "image" and the first on a hand "wrist_image"; further ones keep their names.
        states: robomimic's name -> size of the low-dimensional observations, in order.
        image_size: height and width of all images, pixels.
    """

    order: dict[str, int]
    cameras: dict[str, str]
    states: dict[str, int]
    image_size: tuple[int, int]

    @classmethod
    def of(cls, config: PublishedConfig) -> ImageLayout:
        """Parse the layout in ``policy.shape_meta``.

        Raises:
            InputError: if there is no camera or no state, or images of several sizes.
        """
        order: dict[str, int] = {}
        cameras: dict[str, str] = {}
        sizes = set()
        for key in config.names("policy.shape_meta.obs") or ():
            shape = _sizes(config, f"policy.shape_meta.obs.{key}.shape")
            kind = config.get(f"policy.shape_meta.obs.{key}.type", str, "low_dim")
            if kind not in ("rgb", "low_dim"):
                raise InputError(f"cfg: shape_meta: {key}: type: expected rgb or low_dim, got {kind}")
            if kind == "rgb":
                cameras[_camera_name(key, cameras)] = key
                sizes.add(shape)
                order[key] = _FEATURES
            elif len(shape) == 1:
                order[key] = shape[0]
            else:
                raise InputError(f"cfg: shape_meta: {key}: expected an image or one axis, got shape {shape}")
        states = {key: size for key, size in order.items() if key not in cameras.values()}
        if not states or len(sizes) != 1 or len(size := sizes.pop()) != 3 or size[0] != 3:
            raise InputError(
                f"cfg: shape_meta: expected states and RGB images of one size, got {list(order)}"
            )
        return cls(order, cameras, states, (size[1], size[2]))

    @property
    def features(self) -> int:
        """Size of the condition."""
        return sum(self.order.values())

    def columns(self) -> list[int]:
        """Return for each number of this library's condition, cameras first, its index in the published condition."""
        first, places = 0, {}
        for key, size in self.order.items():
            places[key] = range(first, first + size)
            first += size
        return [column for key in (*self.cameras.values(), *self.states) for column in places[key]]


def read_vision(
    archive: TorchArchive, config: PublishedConfig, layout: ImageLayout, stored: dict[str, StoredTensor]
) -> VisionEncoder:
    """Build the encoder of all cameras, in evaluation mode.

    Args:
        archive: the checkpoint.
        config: its configuration.
        layout: which cameras there are.
        stored: tensors by name, without ``obs_encoder.obs_nets.``.

    Raises:
        InputError: if tensors are missing, do not fit together or describe another encoder.
    """
    said = "crop_shape" in (
        config.names("policy") or ()
    )  # null is none, and nothing is the published default
    cropped = not said or config.get("policy.crop_shape", list, None) is not None
    if cropped and not config.get("policy.eval_fixed_crop", bool, False):
        raise InputError(
            "cfg: policy.eval_fixed_crop: expected true, got false: crops would be random in use"
        )
    crop: tuple[int, ...] = layout.image_size
    if cropped:
        crop = _sizes(config, "policy.crop_shape") if said else _DEFAULT_CROP
    tensors: dict[str, Tensor] = {}
    widths = set()
    for name, key in layout.cameras.items():
        camera = _camera_tensors(archive, key, take(stored, f"{key}."))
        widths.add(camera["trunk.0.weight"].shape[0] if "trunk.0.weight" in camera else 0)
        tensors |= {f"encoders.{name}.{part}": value for part, value in camera.items()}
    if stored or len(widths) != 1:
        raise InputError(
            f"obs_encoder: expected cameras {list(layout.cameras.values())}, got {sorted(stored)[:5]}"
        )
    arguments: dict[str, Any] = {"image_size": layout.image_size, "crop_size": crop, "width": widths.pop()}
    with torch.device("meta"):
        expected = VisionEncoder(list(layout.cameras), **arguments).state_dict()
    check_shapes("obs_encoder", shapes_of(tensors), shapes_of(expected))
    vision = VisionEncoder(list(layout.cameras), **arguments)
    vision.load_state_dict(tensors)
    return vision.eval()


def _sizes(config: PublishedConfig, path: str) -> tuple[int, ...]:
    sizes = config.get(path, list)
    if not all(type(size) is int for size in sizes):
        raise InputError(
            f"cfg: {path}: expected whole numbers, got {[type(size).__name__ for size in sizes]}"
        )
    return tuple(sizes)


def _camera_name(key: str, taken: Mapping[str, str]) -> str:
    name = "wrist_image" if _HAND in key else "image"
    return key if name in taken else name


def _camera_tensors(archive: TorchArchive, key: str, stored: dict[str, StoredTensor]) -> dict[str, Tensor]:
    """Return the weights of one camera under the names of `CameraEncoder`."""
    for twin in (
        "backbone.",
        "pool.",
    ):  # robomimic registers these modules a second time, under nets.0 and nets.1
        take(stored, twin)
    tensors = read_tensors(archive, f"obs_encoder: {key}", stored)
    pool = {name: tensors.pop(f"nets.1.{name}", None) for name in ("temperature", "pos_x", "pos_y")}
    _check_pool(key, pool)
    return {_rename(name): value for name, value in tensors.items()}


def _rename(name: str) -> str:
    for pattern, replacement in _RENAMED:
        name = re.sub(pattern, replacement, name)
    return re.sub(r"\.bn(\d)\.", r".norm\1.", name)


def _check_pool(key: str, pool: Mapping[str, Tensor | None]) -> None:
    """Refuse coordinates of keypoints other than those of `spatial_softmax`, and temperatures other than 1."""
    temperature, x, y = (pool[name] for name in ("temperature", "pos_x", "pos_y"))
    if temperature is None or x is None or y is None:
        raise InputError(f"obs_encoder: {key}: expected a spatial softmax, got none")
    if temperature.numel() != 1 or temperature.item() != 1:
        raise InputError(
            f"obs_encoder: {key}: expected temperature 1, got {temperature.flatten()[:3].tolist()}"
        )
    height, width = len(y.unique()), len(x.unique())
    if height * width != x.numel():  # the grid could be as large as the square of what the file holds
        raise InputError(
            f"obs_encoder: {key}: expected a regular grid from -1 to 1, got {height} x {width} in {x.numel()}"
        )
    grid = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    for name, found, expected in (("pos_y", y, grid[0]), ("pos_x", x, grid[1])):
        if found.shape != (1, expected.numel()) or not torch.allclose(
            found, expected.reshape(1, -1), atol=1e-6
        ):
            raise InputError(f"obs_encoder: {key}: {name}: expected a regular grid from -1 to 1")
