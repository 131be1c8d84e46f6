"""Cameras and an instruction as the condition's features: the observation encoder of LeRobot's ``multi_task_dit``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.clip import ClipText, ClipVision
from torchrl_sparse.networks.diffusion.vision import crop_centre, crop_random

__all__ = ["ClipEncoder"]

Tokenize = Callable[[str], Sequence[int]]


class ClipEncoder(nn.Module):
    """Features of several cameras, of one CLIP tower or of one each, and of an instruction.

    Args:
        cameras: names of the images, ``("history", name)`` in a TensorDict; their features come in this order.
        image_size: height and width of the images, pixels.
        resize: height and width that images are resized to, bilinearly with antialiasing; None keeps them.
        crop: height and width of the part that the tower sees, the middle outside of training; None is all.
        vision: arguments of `ClipVision`; None without cameras.
        separate: a tower for each camera, not one for all.
        text: arguments of `ClipText`.
        text_dim: size of an instruction's features.

    Attributes:
        feature_dim: size of the cameras' features together.
        instructions: token ids of the instructions that it knows.
        tokenize: makes token ids of others; None where no tokenizer came with the weights.
        instruction: what a call without one is told to do; None has no such.

    Raises:
        InputError: if a size is out of range, or images do not become as large as the tower's.
    """

    def __init__(
        self,
        cameras: Sequence[str],
        *,
        image_size: Sequence[int] = (0, 0),
        resize: Sequence[int] | None = None,
        crop: Sequence[int] | None = None,
        vision: Mapping[str, Any] | None = None,
        separate: bool = False,
        text: Mapping[str, Any],
        text_dim: int,
    ) -> None:
        super().__init__()
        self.config: dict[str, Any] = {
            "type": "clip",
            "cameras": list(cameras),
            "image_size": list(image_size),
            "resize": None if resize is None else list(resize),
            "crop": None if crop is None else list(crop),
            "vision": None if vision is None else dict(vision),
            "separate": separate,
            "text": dict(text),
            "text_dim": text_dim,
        }
        self.cameras, self.image_size, self.text_dim = tuple(cameras), tuple(image_size), text_dim
        self.resize = None if resize is None else (resize[0], resize[1])
        self.crop = None if crop is None else (crop[0], crop[1])
        self.feature_dim = 0
        self.towers = nn.ModuleList()
        if vision is not None and cameras:
            self.towers.extend(ClipVision(**vision) for _ in range(len(cameras) if separate else 1))
            self.feature_dim = len(cameras) * vision["width"]
            seen = self.crop or self.resize or self.image_size
            if seen != (vision["size"], vision["size"]):
                raise InputError(
                    f"image_size: expected images of {vision['size']} x {vision['size']} pixels after resize and crop, "
                    f"as CLIP's tower sees them, got {' x '.join(map(str, seen))}"
                )
        for name in ("pixel_shift", "pixel_offset"):
            self.register_buffer(name, torch.zeros(len(cameras), 3, 1, 1))
        self.register_buffer("pixel_scale", torch.ones(len(cameras), 3, 1, 1))
        self.text = ClipText(**text)
        self.projection = nn.Linear(text["width"], text_dim)
        self.instructions: dict[str, list[int]] = {}
        self.tokenize: Tokenize | None = None
        self.instruction: str | None = None
        self._texts: tuple[Any, dict[tuple[int, ...], Tensor]] = (None, {})

    def forward(self, images: Mapping[str, Tensor]) -> Tensor:
        """Return the features [*B, feature_dim] of images by camera, u8 [*B, 3, h, w] or floats in [0, 1].

        Raises:
            InputError: if images have another type or size.
        """
        return torch.cat([self._encode(index, images[name]) for index, name in enumerate(self.cameras)], -1)

    def _encode(self, index: int, images: Tensor) -> Tensor:
        name, shape = self.cameras[index], (3, *self.image_size)
        whole = images.dtype == torch.uint8
        if not (whole or images.is_floating_point()) or tuple(images.shape[-3:]) != shape:
            raise InputError(
                f"image {name!r}: expected uint8 or floats in [0, 1] [*B, {', '.join(map(str, shape))}], "
                f"got {str(images.dtype).removeprefix('torch.')} {list(images.shape)}"
            )
        pixels = images.reshape(-1, *shape).to(self.projection.weight.dtype)
        pixels = pixels / 255 if whole else pixels
        pixels = (pixels - self.pixel_shift[index]) * self.pixel_scale[index] + self.pixel_offset[index]
        if self.resize is not None:
            pixels = functional.interpolate(pixels, self.resize, mode="bilinear", antialias=True)
        if self.crop is not None:
            pixels = (crop_random if self.training else crop_centre)(pixels, self.crop)
        features = self.towers[index if len(self.towers) > 1 else 0](pixels)
        return features.reshape(*images.shape[:-3], features.shape[-1])

    def text_features(self, instructions: Sequence[str]) -> Tensor:
        """Return the features [N, text_dim] of N instructions, each computed once as long as weights stay.

        Raises:
            InputError: if one is not known and there is no tokenizer.
        """
        keyed = {text: tuple(self._ids(text)) for text in dict.fromkeys(instructions)}
        if torch.is_grad_enabled():
            encoded = {ids: self._encode_text(ids) for ids in dict.fromkeys(keyed.values())}
        else:
            encoded = self._known_texts()
            for ids in keyed.values():
                if ids not in encoded:
                    encoded[ids] = self._encode_text(ids)
        return torch.stack([encoded[keyed[text]] for text in instructions])

    def _encode_text(self, ids: tuple[int, ...]) -> Tensor:
        with torch.no_grad():  # frozen, as published
            features = self.text(ids)
        return self.projection(features)

    def _known_texts(self) -> dict[tuple[int, ...], Tensor]:
        weights = (*self.text.parameters(), *self.projection.parameters())
        state = [(id(weight), weight.data_ptr(), weight._version) for weight in weights]
        known, encoded = self._texts  # read and replaced in one go: other threads may do the same
        if known != state:
            encoded = {}
            self._texts = state, encoded
        return encoded

    def know(self, source: Mapping[str, Any]) -> None:
        """Take the ``"instructions"`` and the ``"instruction"`` of a policy's ``source``.

        The dictionary is kept, so that the source notes what is tokenised later.

        Raises:
            InputError: if they are no texts with token ids.
        """
        known = source.get("instructions", {})
        for text, ids in known.items() if isinstance(known, dict) else [("", None)]:
            if not isinstance(ids, list) or not all(type(number) is int for number in ids):
                raise InputError(f"instructions: expected text -> token ids, got {text!r}: {ids!r}")
        instruction = source.get("instruction")
        if instruction is not None and not isinstance(instruction, str):
            raise InputError(f"instruction: expected a text, got {instruction!r}")
        self.instructions, self.instruction = known, instruction

    def refresh(self) -> None:
        """Encode instructions again in the next call."""
        self._texts = (None, {})

    def _ids(self, text: str) -> Sequence[int]:
        if text not in self.instructions:
            if self.tokenize is None:
                known = ", ".join(map(repr, self.instructions)) or "none"
                raise InputError(
                    f"language_instruction: expected one whose tokens are known ({known}), as no tokenizer.json came with the "
                    f"policy, got {text!r}; DiffusionPolicy.from_lerobot(folder, tokens={{text: ids}}) adds it"
                )
            self.instructions[text] = list(self.tokenize(text))
        return self.instructions[text]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_texts": (None, {})}
