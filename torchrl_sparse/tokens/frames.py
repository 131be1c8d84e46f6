"""Patch-wise image changes since the last policy call, or since an earlier one while the hand is slow."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.hooks import VisualSpec

__all__ = ["FRAME_KEYS", "compare_frames", "look_back", "past_frame_keys", "patches", "similarity"]

FRAME_KEYS = [keys.TOKEN_FRAMES, keys.IS_INIT]
"""Keys that `compare_frames` reads beside the images."""


def past_frame_keys(furthest: int) -> list[NestedKey]:
    """Return the keys that `compare_frames` reads beside `FRAME_KEYS` to look ``furthest`` calls back; it writes the first too.

    Raises:
        InputError: if that is less than one call.
    """
    if furthest < 1:
        raise InputError(f"look_back: expected at least 1 policy call, got {furthest}")
    return [keys.TOKEN_PAST_FRAMES, keys.EEF_VEL] if furthest > 1 else []


def patches(frames: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the pixels of each patch, f64 [B, V * rows * columns, P], camera by camera and row by row.

    Args:
        frames: u8 [B, V, 3, h, w].
        grid: rows and columns, which divide h and w.

    Raises:
        InputError: if they do not.

    Examples:
        >>> patches(torch.arange(4, dtype=torch.uint8).reshape(1, 1, 1, 2, 2), (2, 2)).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0]
    """
    (height, width), (rows, columns) = frames.shape[-2:], grid
    if height % rows or width % columns:
        raise InputError(
            f"frames: expected a size that {rows} x {columns} patches divide, got {height} x {width}"
        )
    cut = frames.unflatten(-1, (columns, -1)).unflatten(-3, (rows, -1))  # [B, V, 3, rows, y, columns, x]
    cut = cut.permute(0, 1, 3, 5, 2, 4, 6).flatten(4).flatten(1, 3)
    # Sums of products of bytes are exact in double precision, so that equal patches are equally similar in any batch.
    return cut.double()


def similarity(previous: Tensor, current: Tensor) -> Tensor:
    """Return the cosine between patches of two frames, f32 [...]: Eq. 2 of SpecPrune-VLA (arXiv:2509.05614).

    Two black patches are alike; a black one is unlike any other.

    Args:
        previous, current: [..., P] patches.

    Examples:
        >>> similarity(torch.tensor([[1.0, 0], [0, 0], [0, 0]]), torch.tensor([[3.0, 3], [0, 0], [0, 1]]))
        tensor([0.7071, 1.0000, 0.0000])
    """
    before, after = previous.square().sum(-1), current.square().sum(-1)
    scale = (before * after).sqrt()
    cosine = (previous * current).sum(-1) / scale.clamp_min(torch.finfo(scale.dtype).tiny)
    return torch.where((before == 0) & (after == 0), 1.0, cosine).float()


def look_back(speed: Tensor, furthest: int, swift: float) -> Tensor:
    """Return how many policy calls ago the frame to compare with was taken, i64 [...], from 1 to ``furthest``.

    A slow hand changes little from one call to the next, and what it changes would pass for standing still. So the slower,
    the further back, and linearly, as in the release of SpecPrune-VLA (arXiv:2509.05614). That counts environment steps, 6 for
    a hand at rest, and reads commanded actions; here it is calls and the measured speed, since a pruner sees no other frames.

    Args:
        speed: of the hand, m/s.
        furthest: calls for a hand at rest.
        swift: m/s, at and above which the last call's frame is taken.

    Examples:
        >>> look_back(torch.tensor([0.0, 0.1, 0.2, 0.3, 9.0]), furthest=4, swift=0.3).tolist()
        [4, 3, 2, 1, 1]
    """
    return 1 + ((furthest - 1) * (1 - speed / swift).clamp(min=0)).round().long()


def compare_frames(
    td: TensorDictBase, spec: VisualSpec, furthest: int = 1, swift: float = 0.3
) -> tuple[Tensor, Tensor]:
    """Compare this policy call's images with an earlier call's, and store them for later calls.

    Args:
        td: a call [B] with the cameras' images, u8 [B, 3, h, w]; ``("tokens", "frames")`` is read and replaced, and where
            ``furthest`` is above 1 ``("tokens", "past_frames")`` too, for which ``("observation", "eef_vel")`` is read.
        furthest, swift: see `look_back`; by default it is always the last call.

    Returns:
        f32 [B, N] similarity of each patch, and bool [B, 1] whether there was nothing to compare with: an episode's first
        call, or a last one in the dark.
    """
    frames = torch.stack([keys.read(td, camera) for camera in spec.cameras], 1)
    previous = keys.recall(td, keys.TOKEN_FRAMES, frames.shape[1:], 0, frames.dtype)
    first = keys.read(td, keys.IS_INIT) | (previous.flatten(1).amax(-1, keepdim=True) == 0)
    if furthest > 1:
        previous = _earlier_frames(td, previous, first, furthest, swift)
    alike = similarity(patches(previous, spec.grid), patches(frames, spec.grid))
    td.set(keys.TOKEN_FRAMES, frames)
    return alike, first


def _earlier_frames(td: TensorDictBase, last: Tensor, first: Tensor, furthest: int, swift: float) -> Tensor:
    """Return the frames to compare with, u8 [B, V, 3, h, w]: the oldest of the episode where it has not been so many."""
    shape = (furthest - 1, *last.shape[1:])
    past = torch.cat([last[:, None], keys.recall(td, keys.TOKEN_PAST_FRAMES, shape, 0, last.dtype)], 1)
    past = past.masked_fill(first[(...,) + (None,) * (past.ndim - 2)], 0)  # another episode's
    td.set(keys.TOKEN_PAST_FRAMES, past[:, :-1])
    taken = past.flatten(2).amax(-1).ne(0).sum(-1).clamp(min=1)
    ago = look_back(_slowest_hand(td), furthest, swift).minimum(taken)
    return past[torch.arange(len(past), device=past.device), ago - 1]


def _slowest_hand(td: TensorDictBase) -> Tensor:
    """Return the speed of the arm that moves least, f32 [B] in m/s."""
    velocity = keys.read(td, keys.EEF_VEL).unflatten(-1, (-1, 6))
    return torch.linalg.vector_norm(velocity[..., :3], dim=-1).amin(-1)
