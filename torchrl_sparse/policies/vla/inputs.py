"""Readers of a vision-language-action policy's inputs from a flat TensorDict [B]; errors name key, expected and found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import dense
from torchrl_sparse.errors import InputError

__all__ = ["read_images", "read_instructions", "read_keep_mask", "read_query", "read_state"]


def read_query(td: TensorDictBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """Return what ``policy`` reads, [B].

    Raises:
        InputError: if there is no row.
    """
    rows = td.batch_size.numel()
    if not rows:
        raise InputError(f"batch: expected at least one policy call, got batch size {list(td.batch_size)}")
    return dense(td.select(*policy.in_keys, strict=False), policy).reshape(rows)


def read_images(td: TensorDictBase, cameras: Sequence[NestedKey], size: int) -> Tensor:
    """Return the images, u8 [B, cameras, 3, size, size].

    Raises:
        KeyError: if a camera is missing.
        InputError: if an image has another type or size.
    """
    images = [keys.read(td, camera) for camera in cameras]
    for camera, image in zip(cameras, images, strict=True):
        _check(camera, image, torch.uint8, (3, size, size))
    return torch.stack(images, dim=1)


def read_state(td: TensorDictBase, key: NestedKey, size: int) -> Tensor:
    """Return the state, f32 [B, size].

    Raises:
        KeyError: if it is missing.
        InputError: if it has another type or size, or is not finite.
    """
    state = keys.read(td, key)
    _check(key, state, torch.float32, (size,))
    if not state.isfinite().all():
        row = state[~state.isfinite().all(1)][0].tolist()
        raise InputError(f"{key}: expected finite numbers, got {row}")
    return state


def read_keep_mask(td: TensorDictBase, num_visual: int) -> Tensor | None:
    """Return the visual tokens to keep, bool [B, num_visual], or None if no mask was written.

    Raises:
        InputError: if it has another type or size.
    """
    mask = td.get(keys.KEEP_MASK, None)
    if mask is not None:
        _check(keys.KEEP_MASK, mask, torch.bool, (num_visual,))
    return mask


def read_instructions(td: TensorDictBase, key: NestedKey) -> list[str]:
    """Return B instructions, repeating a single one.

    Raises:
        KeyError: if it is missing.
        TypeError: if it is not text.
    """
    value = keys.read(td, key)
    found = _texts(value.tolist() if hasattr(value, "tolist") else value)
    wrong = [item for item in found if not isinstance(item, str)]
    if wrong:
        raise TypeError(f"{key}: expected text, got {type(wrong[0]).__name__}")
    return found * td.batch_size[0] if len(found) == 1 else found


def _texts(value: Any) -> list:
    if isinstance(value, (list, tuple)):
        return [text for item in value for text in _texts(item)]
    return [value]


def _check(key: NestedKey, value: Tensor, dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    if value.dtype != dtype or tuple(value.shape[1:]) != shape:
        raise InputError(
            f"{key}: expected {dtype} [*B, {', '.join(map(str, shape))}], got {value.dtype} {list(value.shape)}"
        )
