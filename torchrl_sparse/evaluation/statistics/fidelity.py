"""Errors of a sparse policy call relative to the dense one, for the same observation and noise."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["action_error", "block_errors", "relative_error"]

_AT_ONCE = 8  # policy calls whose features are held at once: 25 MB each, of the published models


def action_error(chunks: Tensor, dense_chunks: Tensor) -> tuple[float, float]:
    """Return the mean and maximum absolute difference of action entries, in the chunks' units.

    Args:
        chunks: of the method, [..., H, A].
        dense_chunks: of the dense policy on the same observations and noise, same shape.

    Raises:
        InputError: if the shapes differ.

    >>> mean, largest = action_error(torch.tensor([[[0.0, 0.5]]]), torch.tensor([[[0.0, 0.0]]]))
    >>> mean, largest
    (0.25, 0.5)
    """
    if chunks.shape != dense_chunks.shape:
        raise InputError(f"chunks: expected shape {tuple(dense_chunks.shape)}, got {tuple(chunks.shape)}")
    difference = (chunks - dense_chunks).abs()
    return float(difference.mean()), float(difference.max())


def relative_error(features: Tensor, dense_features: Tensor) -> Tensor:
    """Return ``‖x − dense‖₂ / ‖dense‖₂`` of every block's output at every denoising step, averaged over samples.

    Args:
        features: [3L, K, B, ...] outputs as :class:`FeatureRecorder` returns them.
        dense_features: of the dense run on the same noise, same shape.

    Returns:
        f64 [K, 3L].

    Raises:
        InputError: if the shapes differ.

    >>> relative_error(torch.full((3, 2, 1, 4), 1.5), torch.ones(3, 2, 1, 4)).shape
    torch.Size([2, 3])
    """
    if features.shape != dense_features.shape:
        expected, got = tuple(dense_features.shape), tuple(features.shape)
        raise InputError(f"features: expected shape {expected}, got {got}")
    dense = dense_features.double().flatten(3)
    difference = features.double().flatten(3) - dense
    norm = dense.norm(dim=-1).clamp_min(torch.finfo(torch.float64).tiny)
    return (difference.norm(dim=-1) / norm).mean(dim=-1).T


@torch.no_grad()
def block_errors(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    masks: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """Return the relative errors of the blocks under several schedules: the error surge (figure 3 of BAC, arXiv:2506.13456).

    Args:
        network: the denoiser, in eval mode.
        sampler: the denoising steps, K of them.
        noise: f32 [N, K, H, A], as :func:`~torchrl_sparse.blocks.engine.reference.denoise` takes it.
        cond: encoded observations f32 [N, To, D].
        masks: name -> mask, bool [K, 3L], True = pruned.

    Returns:
        name -> f64 [K, 3L], see :func:`relative_error`.

    Raises:
        InputError: if shapes do not fit or a mask prunes its first row.
    """
    errors = {name: torch.zeros(mask.shape, dtype=torch.float64) for name, mask in masks.items()}
    for part_noise, part_cond in zip(noise.split(_AT_ONCE), cond.split(_AT_ONCE), strict=True):
        dense = _features(network, sampler, part_noise, part_cond, None)
        for name, mask in masks.items():
            sparse = _features(network, sampler, part_noise, part_cond, mask)
            errors[name] += relative_error(sparse, dense).cpu() * (len(part_cond) / len(cond))
    return errors


def _features(
    network: Denoiser, sampler: Sampler, noise: Tensor, cond: Tensor, mask: Tensor | None
) -> Tensor:
    """Return the output of every block at every step, [3L, K, N, H, D]."""
    recorder = FeatureRecorder()
    batched = None if mask is None else mask.expand(len(cond), -1, -1)
    denoise(network, sampler, noise, cond, batched, record=recorder)
    return recorder.features()
