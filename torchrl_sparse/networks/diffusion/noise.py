"""Seeded noise: one integer fixes all randomness of a policy call, so methods can be compared on the same noise."""

from __future__ import annotations

import threading
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError

NOISE_STREAM = 2**32
"""Between the seeds of two noises that an episode could have had; no seed of an episode is as large."""

_BITS = 2**64 - 1
_WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


class _Own(threading.local):
    """A generator for each thread: making one takes longer than seeding it."""

    def __init__(self) -> None:
        self.generator = torch.Generator()


_OWN = _Own()


def query_seed(episode_seed: Tensor, episode_step: Tensor, stream: int = 0) -> Tensor:
    """Return one seed, i64 and non-negative, for each step of each episode, the same in every process and batch.

    Args:
        episode_seed, episode_step: whole numbers of one shape.
        stream: which of the noises that an episode could have had.

    >>> query_seed(torch.tensor([[7]]), torch.tensor([[0]])).tolist()
    [[3017209365954019450]]
    """
    # In Python's numbers: for a few rows, torch's first operation takes longer than all of this.
    begin = stream * NOISE_STREAM
    pairs = zip(episode_seed.reshape(-1).tolist(), episode_step.reshape(-1).tolist(), strict=True)
    seeds = [_mix((seed + begin) * 1_000_003 + step) for seed, step in pairs]
    shape, kind = episode_seed.shape, {"dtype": torch.int64, "device": episode_seed.device}
    if len(seeds) == 1:  # a number is written faster than a list of one
        return torch.full(shape, seeds[0], **kind)
    return torch.tensor(seeds, **kind).view(shape)


def sample_noise(seed: Tensor, num_steps: int, chunk_shape: tuple[int, int]) -> Tensor:
    """Draw the noise of B policy calls, f32 [B, num_steps, H, A], row i from ``seed[i]`` alone.

    Entry 0 is the initial sample, whatever ``num_steps``: a ten-step and a hundred-step sampler start from the same point,
    and so they are paired. The gaussians of the transitions follow in one stream, entry k of a short chain being entry k
    of a long one (of the last entry up to 16 numbers may differ, which is how torch draws); but those belong to other
    intervals of noise, so that sharing them pairs nothing more. Chains of the same timesteps share everything.

    Args:
        seed: i64 [B].
        num_steps: denoising steps K.
        chunk_shape: (H, A).

    Raises:
        InputError: if seeds are no whole numbers.
    """
    check_whole("seed", seed)
    noise, generator = torch.empty(len(seed), num_steps, *chunk_shape), _OWN.generator
    for row, value in zip(noise, seed.tolist(), strict=True):
        generator.manual_seed(value)
        row[:1].normal_(generator=generator)
        row[1:].normal_(generator=generator)
    return noise if seed.is_cpu else noise.to(seed.device)


def check_whole(name: Any, tensor: Tensor) -> None:
    """Raise InputError unless ``tensor`` holds integers, since a generator would truncate fractions to another seed."""
    if tensor.dtype not in _WHOLE:
        raise InputError(f"{name}: expected whole numbers, got {tensor.dtype}")


def _mix(value: int) -> int:
    """Spread neighbouring numbers over all bits by a round of SplitMix64 (Steele et al., OOPSLA 2014); return 63 of them."""
    value = value + 0x9E3779B97F4A7C15 & _BITS
    value = (value ^ value >> 30) * 0xBF58476D1CE4E5B9 & _BITS
    value = (value ^ value >> 27) * 0x94D049BB133111EB & _BITS
    return (value ^ value >> 31) & _BITS >> 1
