"""Rules that choose a sampler's timesteps from their number.

``"leading"``, ``"trailing"`` and ``"linspace"`` are diffusers' (arXiv:2305.08891, Table 2), whose solvers leave out
timestep 0 where DDPM and DDIM end on it. ``"logsnr"`` is the rule that needs no search::

    first    = how many timesteps have lambda = log(sqrt(abar) / sqrt(1 - abar)), half the log-SNR, >= -2.1
    timestep = round(first - k T / K) - 1        k = 0 .. K-1

so diffusers' ``"trailing"`` with ``lambda_min_clipped=-2.1``. Of a hundred: 91, 41; 91, 58, 24; 91, 66, 41, 16.

It follows from where few steps lose. *The first step* is asked about pure noise. Its clean prediction
``(sample - sigma eps) / alpha`` amplifies whatever is wrong with the predicted noise by ``sigma / alpha = e^-lambda``:
by 8 at timestep 91, by 16 at 95, by 2,000 at 99, where ``"trailing"`` begins and clipping leaves little but signs.
Further down, pure noise lacks the signal, of amplitude ``alpha``, that the network was trained to find: 0.12 at
timestep 91, 0.49 at 66, where ``"leading"`` begins with three steps. The rule begins where the second is still small
and the first not yet large. That it begins at -2.1 is a choice, at the noisy end of where searches for single policies
end (80 to 91 of 100, see `torchrl_sparse.training.diffusion.timesteps`); no theory gives the number. *The last step*
jumps to the clean sample from wherever it is, and at timestep 0, where ``"leading"`` ends, there is hardly anything
left to do: the spacing therefore counts from above.
"""

from __future__ import annotations

import reprlib
import warnings
from collections.abc import Sequence
from itertools import pairwise
from numbers import Integral

import numpy as np
from torch import Tensor

from torchrl_sparse.errors import InputError

__all__ = ["SPACINGS", "check_timesteps", "falls_evenly", "spaced_timesteps", "timesteps_fall"]

SPACINGS = ("leading", "trailing", "linspace", "logsnr")
_SMALLEST_LOG_RATIO = -2.1
_FAR_FROM_NOISE = 0.3
"""Amplitude of the signal at a first timestep that is shown noise alone; 0.12 where ``"logsnr"`` begins."""


def spaced_timesteps(
    spacing: str, num_steps: int, alphas_cumprod: Tensor, *, without_last: bool = False
) -> list[int]:
    """Return the timesteps of a spacing, in execution order.

    Args:
        spacing: one of :data:`SPACINGS`.
        num_steps: K.
        alphas_cumprod: abar of every diffusion timestep, f32 [T].
        without_last: leave out the last timestep of ``"leading"`` and ``"linspace"``, as diffusers' solvers do.

    Raises:
        InputError: on an unknown spacing, or where K is so large that they would repeat or leave 0 .. T-1.

    Warns:
        UserWarning: where they begin far from pure noise. ``"leading"`` does, in diffusers too, with few steps and with most
            numbers above T / 3 that do not divide T: 51 of 100 begin at timestep 50.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> abar = Sampler().alphas_cumprod
        >>> [spaced_timesteps(spacing, 5, abar) for spacing in SPACINGS[:3]]
        [[80, 60, 40, 20, 0], [99, 79, 59, 39, 19], [99, 74, 50, 25, 0]]
        >>> spaced_timesteps("logsnr", 2, abar), spaced_timesteps("logsnr", 3, abar)
        ([91, 41], [91, 58, 24])
    """
    if spacing not in SPACINGS:
        raise InputError(f"spacing: expected one of {', '.join(SPACINGS)}, got {spacing!r}")
    num_train, points = len(alphas_cumprod), num_steps + without_last
    rising: np.ndarray
    if spacing == "leading":
        rising = np.arange(points) * (num_train // points)
    elif spacing == "linspace":
        rising = np.linspace(0, num_train - 1, points).round()
    else:
        first = num_train if spacing == "trailing" else _first_clear(alphas_cumprod)
        gap = num_train / num_steps
        rising = np.arange(first, first - (num_steps - 0.5) * gap, -gap).round()[::-1] - 1
    found = rising[::-1][:num_steps].astype(int).tolist()
    if not timesteps_fall(found, num_train):
        raise InputError(
            f"num_inference_steps: expected fewer, {spacing!r} has no {num_steps} falling timesteps of {num_train} here"
        )
    if num_train > 1 and (amplitude := alphas_cumprod[found[0]].item() ** 0.5) > _FAR_FROM_NOISE:
        warnings.warn(
            f"num_inference_steps={num_steps}: {spacing!r} begins at timestep {found[0]} of {num_train}, where the network "
            f'expects {amplitude:.2f} of the actions\' amplitude and is shown noise; "logsnr" begins where it expects 0.12',
            stacklevel=4,
        )
    return found


def _first_clear(alphas_cumprod: Tensor) -> int:
    """Return how many timesteps are clear enough to begin at."""
    log_ratio = 0.5 * (alphas_cumprod / (1 - alphas_cumprod)).log()
    return int((log_ratio >= _SMALLEST_LOG_RATIO).sum())


def check_timesteps(timesteps: Sequence[float], num_steps: int, num_train_timesteps: int) -> list[int]:
    """Return chosen timesteps as ints; ValueError unless they are ``num_steps`` decreasing integers.

    >>> check_timesteps((82, 14), 2, 100)
    [82, 14]
    """
    chosen = list(timesteps)
    whole = all(isinstance(timestep, Integral) for timestep in chosen)
    if not whole or not timesteps_fall(chosen, num_train_timesteps) or len(chosen) != num_steps:
        raise InputError(
            f"timesteps: expected {num_steps} (num_inference_steps) whole numbers that fall from at most "
            f"{num_train_timesteps - 1} to at least 0, got {reprlib.repr(chosen)}"
        )
    return [int(timestep) for timestep in chosen]


def timesteps_fall(timesteps: Sequence[float], num_train_timesteps: int) -> bool:
    """Return whether timesteps decrease strictly, from below ``num_train_timesteps`` down to at least 0.

    >>> timesteps_fall([99, 0], 100), timesteps_fall([100, 0], 100), timesteps_fall([9, 9], 100)
    (True, False, False)
    """
    return all(later < earlier for earlier, later in pairwise((num_train_timesteps, *timesteps, -1)))


def falls_evenly(timesteps: Sequence[int], num_train_timesteps: int) -> bool:
    """Return whether K timesteps are T // K apart, the last one at most that far above the clean sample.

    Whatever the spacing, diffusers' DDIM leads T // K down; elsewhere it asks the network about another timestep than that.

    >>> falls_evenly([90, 60, 30, 0], 120), falls_evenly([99, 66, 33, 0], 100)
    (True, False)
    """
    gap = num_train_timesteps // len(timesteps)
    return all(max(earlier - gap, -1) == later for earlier, later in pairwise((*timesteps, -1)))
