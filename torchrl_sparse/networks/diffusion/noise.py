"""All randomness of a query follows from one integer, so that two methods can be run on the same noise."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

NOISE_STREAM = 2**32
"""Between the seeds of two noises that an episode could have had; no seed of an episode is as large."""

_WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def query_seed(episode_seed: Tensor, episode_step: Tensor) -> Tensor:
    """Return one seed, i64 and non-negative, for each step of each episode, the same in every process and batch.

    A SplitMix64 round spreads neighbouring inputs over all 64 bits (Steele et al., OOPSLA 2014).

    Args:
        episode_seed, episode_step: i64 of one shape.
    """
    mixed = episode_seed * 1_000_003 + episode_step + _signed(0x9E3779B97F4A7C15)
    mixed = (mixed ^ _shift(mixed, 30)) * _signed(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ _shift(mixed, 27)) * _signed(0x94D049BB133111EB)
    return (mixed ^ _shift(mixed, 31)) & (2**63 - 1)


def sample_noise(seed: Tensor, num_steps: int, chunk_shape: tuple[int, int]) -> Tensor:
    """Draw the noise of B queries, f32 [B, num_steps, H, A], row i from ``seed[i]`` alone.

    Entry 0 is the initial sample, whatever ``num_steps``: a ten-step and a hundred-step sampler start from the same point,
    and so they are paired. The gaussians of the transitions follow in one stream, entry k of a short chain being entry k
    of a long one (of the last entry up to 16 numbers may differ, which is how torch draws); but those belong to other
    intervals of noise, so that sharing them pairs nothing more. Chains of the same timesteps share everything.

    Args:
        seed: i64 [B].
        num_steps: denoising steps K.
        chunk_shape: (H, A).

    Raises:
        ValueError: if seeds are no whole numbers.
    """
    check_whole("seed", seed)
    noise = torch.empty(len(seed), num_steps, *chunk_shape)
    for row, value in zip(noise, seed.tolist(), strict=True):
        generator = torch.Generator().manual_seed(value)
        row[:1].normal_(generator=generator)
        row[1:].normal_(generator=generator)
    return noise.to(seed.device)


def check_whole(name: Any, tensor: Tensor) -> None:
    """Raise ValueError unless ``tensor`` holds whole numbers: of a fraction, a generator would take another seed."""
    if tensor.dtype not in _WHOLE:
        raise ValueError(f"{name}: expected whole numbers, got {tensor.dtype}")


def _signed(unsigned: int) -> int:
    """Return the int64 with the same bits: torch has no unsigned arithmetic."""
    return unsigned - 2**64 if unsigned >= 2**63 else unsigned


def _shift(value: Tensor, bits: int) -> Tensor:
    """Shift to the right logically; torch's own is arithmetic."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)
