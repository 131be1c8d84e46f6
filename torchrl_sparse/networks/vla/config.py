"""Sizes of a vision-language-action model: everything that fixes its architecture, and nothing else."""

from __future__ import annotations

import dataclasses
import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tensordict import NestedKey

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.sizes import check_size
from torchrl_sparse.networks.vla.hooks import VisualSpec

__all__ = ["TransformerSize", "VLAConfig"]


# Bounds, far beyond any use, on what a file can ask for before its weights are seen.
_MAX_SIZE, _MAX_LAYERS, _MAX_PIXELS, _MAX_CHUNK = 1 << 20, 256, 4096, 4096
_ADDED: dict[str, Any] = {"kv_heads": None, "rope_base": 10000.0, "norm_eps": 1e-6}
"""Fields that the first files did not have, and what those meant: where it is meant still, files are as they were."""


def _is_key(value: Any) -> bool:
    parts = value if isinstance(value, tuple) else (value,)
    return bool(parts) and all(isinstance(part, str) for part in parts)


@dataclass(frozen=True)
class TransformerSize:
    """Size of a transformer.

    Attributes:
        dim: width of the residual stream.
        layers: published number of layers. A vision tower has one fewer, since the features are those of its second-to-last.
        heads: attention heads.
        mlp: width of the feed-forward network.

    Raises:
        InputError: if a size is no positive number or far too large, or the width is no multiple of the heads with an even
            quotient.
    """

    dim: int
    layers: int
    heads: int
    mlp: int

    def __post_init__(self) -> None:
        for name in ("dim", "heads", "mlp"):
            check_size(name, getattr(self, name), _MAX_SIZE)
        check_size("layers", self.layers, _MAX_LAYERS)
        if self.dim % (2 * self.heads):
            raise InputError(
                f"dim: expected a multiple of 2 * heads = {2 * self.heads} (rotary embeddings), got {self.dim}"
            )


@dataclass(frozen=True)
class VLAConfig:
    """Architecture of OpenVLA-OFT (arXiv:2502.19645) at any size; the defaults are the published 7B model for LIBERO.

    Attributes:
        dino: the DINOv2 tower (with registers).
        siglip: the SigLIP tower.
        llm: the Llama decoder.
        vocab_size: rows of the decoder's embedding.
        image_size: height and width of the images in pixels.
        patch_size: of both towers, pixels.
        registers: register tokens of the DINOv2 tower.
        cameras: keys of the images, primary first.
        state_dim: numbers of ``("observation", "state")``.
        action_dim: numbers of an action A.
        chunk_size: actions of a chunk H.
        crop_area: share of the image's area that is kept, centred, and scaled back; 0.9 for the published checkpoints.
        kv_heads: heads of the decoder's keys and values, each of which serves as many of its queries' (arXiv:2305.13245);
            None is one for each.
        rope_base: of the decoder's rotary embeddings.
        norm_eps: of the decoder's norms.

    Raises:
        InputError: if sizes do not fit together.

    Examples:
        >>> VLAConfig().num_visual, VLAConfig().num_slots, VLAConfig.tiny().num_visual
        (512, 56, 8)
        >>> VLAConfig.from_dict(VLAConfig.tiny().to_dict()) == VLAConfig.tiny()
        True
    """

    dino: TransformerSize = TransformerSize(1024, 24, 16, 4096)
    siglip: TransformerSize = TransformerSize(1152, 27, 16, 4304)
    llm: TransformerSize = TransformerSize(4096, 32, 32, 11008)
    vocab_size: int = 32064
    image_size: int = 224
    patch_size: int = 14
    registers: int = 4
    cameras: tuple[NestedKey, ...] = (keys.IMAGE, keys.WRIST_IMAGE)
    state_dim: int = 8
    action_dim: int = 7
    chunk_size: int = 8
    crop_area: float = 1.0
    kv_heads: int | None = _ADDED["kv_heads"]
    rope_base: float = _ADDED["rope_base"]
    norm_eps: float = _ADDED["norm_eps"]

    def __post_init__(self) -> None:
        for name in ("vocab_size", "registers", "state_dim", "action_dim"):
            check_size(name, getattr(self, name), _MAX_SIZE)
        for name in ("image_size", "patch_size"):
            check_size(name, getattr(self, name), _MAX_PIXELS)
        check_size("chunk_size", self.chunk_size, _MAX_CHUNK)
        if self.image_size % self.patch_size:
            raise InputError(
                f"image_size: expected a multiple of patch_size={self.patch_size}, got {self.image_size}"
            )
        if min(self.dino.layers, self.siglip.layers) < 2:
            raise InputError(
                f"dino, siglip: expected towers of at least 2 layers, got {self.dino.layers} and {self.siglip.layers}"
            )
        if self.dino.mlp % self.dino.dim:
            raise InputError(
                f"dino.mlp: expected a multiple of dino.dim={self.dino.dim}, got {self.dino.mlp}"
            )
        if not 1 <= len(self.cameras) <= 2 or not all(map(_is_key, self.cameras)):
            raise InputError(f"cameras: expected one or two keys, got {reprlib.repr(list(self.cameras))}")
        if type(self.crop_area) not in (int, float) or not 0 < self.crop_area <= 1:
            raise InputError(f"crop_area: expected a share in (0, 1], got {self.crop_area}")
        self._check_decoder()

    def _check_decoder(self) -> None:
        if self.kv_heads is not None:
            check_size("kv_heads", self.kv_heads, _MAX_SIZE)
            if self.llm.heads % self.kv_heads:
                raise InputError(
                    f"kv_heads: expected a divisor of llm.heads={self.llm.heads}, got {self.kv_heads}"
                )
        for name in ("rope_base", "norm_eps"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value < math.inf:
                raise InputError(f"{name}: expected a positive number, got {value}")

    @classmethod
    def tiny(cls, **changes: Any) -> VLAConfig:
        """Return sizes for tests that run in milliseconds; ``changes`` override attributes."""
        tower = TransformerSize(16, 2, 2, 32)
        sizes = {"dino": tower, "siglip": tower, "llm": TransformerSize(32, 4, 2, 64), "vocab_size": 320}
        return cls(**{**sizes, "image_size": 28, "chunk_size": 2, **changes})

    @classmethod
    def small(cls, **changes: Any) -> VLAConfig:
        """Return sizes that a CPU core can train: 3 million parameters, 2 x 36 visual tokens; ``changes`` override
        attributes.
        """
        tower = TransformerSize(96, 4, 4, 384)
        sizes = {"dino": tower, "siglip": tower, "llm": TransformerSize(128, 8, 4, 384), "vocab_size": 512}
        return cls(**{**sizes, "image_size": 84, **changes})

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of image patches."""
        return (self.image_size // self.patch_size,) * 2

    @property
    def num_visual(self) -> int:
        """Visual tokens N of all cameras."""
        return self.visual_spec.num_visual

    @property
    def num_slots(self) -> int:
        """Action tokens of the decoder, one for each number of a chunk."""
        return self.chunk_size * self.action_dim

    @property
    def kv_dim(self) -> int:
        """Width of the decoder's keys and values."""
        return self.llm.dim // self.llm.heads * (self.kv_heads or self.llm.heads)

    @property
    def visual_spec(self) -> VisualSpec:
        """Sizes that determine the visual tokens."""
        return VisualSpec(self.llm.layers, self.cameras, self.grid, self.image_size, self.llm.dim)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON values for `from_dict`."""
        added = {name for name, meant in _ADDED.items() if getattr(self, name) == meant}
        fields = {name: value for name, value in dataclasses.asdict(self).items() if name not in added}
        fields["cameras"] = [list(key) if isinstance(key, tuple) else key for key in self.cameras]
        return fields

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> VLAConfig:
        """Return the sizes that `to_dict` wrote.

        Raises:
            InputError: if a field is missing, unknown or wrong.
        """
        names = {field.name for field in dataclasses.fields(cls)}
        if not isinstance(fields, Mapping) or not names - _ADDED.keys() <= set(fields) <= names:
            found = sorted(fields) if isinstance(fields, Mapping) else type(fields).__name__
            raise InputError(f"expected the fields {sorted(names)}, got {found}")
        towers = {name: _size(name, fields[name]) for name in ("dino", "siglip", "llm")}
        if not isinstance(fields["cameras"], list):
            raise InputError(f"cameras: expected a list of keys, got {reprlib.repr(fields['cameras'])}")
        cameras = tuple(tuple(key) if isinstance(key, list) else key for key in fields["cameras"])
        return cls(**{**fields, **towers, "cameras": cameras})


def _size(name: str, fields: Any) -> TransformerSize:
    try:
        return TransformerSize(**fields)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: {error}") from error
