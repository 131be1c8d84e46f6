"""Changes in the cameras' images since the last query, patch by patch."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import VisualSpec

__all__ = ["FRAME_KEYS", "compare_frames", "patches", "similarity"]

FRAME_KEYS = [keys.TOKEN_FRAMES, keys.IS_INIT]
"""Keys that `compare_frames` reads beside the images."""


def patches(frames: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the pixels of each patch, f64 [B, V * rows * columns, P], camera by camera and row by row.

    Args:
        frames: u8 [B, V, 3, h, w].
        grid: rows and columns, which divide h and w.

    Raises:
        ValueError: if they do not.

    Examples:
        >>> patches(torch.arange(4, dtype=torch.uint8).reshape(1, 1, 1, 2, 2), (2, 2)).flatten().tolist()
        [0.0, 1.0, 2.0, 3.0]
    """
    (height, width), (rows, columns) = frames.shape[-2:], grid
    if height % rows or width % columns:
        raise ValueError(
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


def compare_frames(td: TensorDictBase, spec: VisualSpec) -> tuple[Tensor, Tensor]:
    """Compare the images of this query with those of the last, and remember these.

    Args:
        td: a query [B] with the cameras' images, u8 [B, 3, h, w]; ``("tokens", "frames")`` is read and replaced.

    Returns:
        f32 [B, N] similarity of each patch, and bool [B, 1] whether there was nothing to compare with: an episode's first
        query, or a last one in the dark.
    """
    frames = torch.stack([keys.read(td, camera) for camera in spec.cameras], 1)
    previous = keys.recall(td, keys.TOKEN_FRAMES, frames.shape[1:], 0, frames.dtype)
    first = keys.read(td, keys.IS_INIT) | (previous.flatten(1).amax(-1, keepdim=True) == 0)
    alike = similarity(patches(previous, spec.grid), patches(frames, spec.grid))
    td.set(keys.TOKEN_FRAMES, frames)
    return alike, first
