"""Flow matching (arXiv:2210.02747) with straight paths: Euler steps along a predicted velocity.

A training pair is ``x_t = t data + (1 - t) noise`` with t from 0, noise, to 1, data; the network predicts
``data - noise``. A step from t to s is ``x + (s - t) v``, which is

    clean = x + (1 - t) v
    next  = r clean + (1 - r) x          r = (s - t) / (1 - t)

so that it reads as every other sampler's: a step toward a clean prediction, which a `Guide` may draw elsewhere. The
published schedule (LeRobot's ``multi_task_dit``, OpenPI) is K even steps from 0; times may be chosen too. Nothing is clipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from numbers import Real

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import StepCoefficients

__all__ = ["flow_coefficients", "flow_times"]


def flow_times(num_steps: int, chosen: Sequence[float] | None = None) -> Tensor:
    """Return the time of each step, rising from 0, and 1 after the last, f32 [K + 1].

    Raises:
        InputError: unless ``chosen`` are ``num_steps`` numbers that rise, from at least 0 to below 1.

    >>> flow_times(4).tolist(), flow_times(2, [0, 0.5]).tolist()
    ([0.0, 0.25, 0.5, 0.75, 1.0], [0.0, 0.5, 1.0])
    """
    if chosen is None:
        return torch.linspace(0, 1, num_steps + 1)
    times = [*chosen, 1.0]
    numbers = all(isinstance(time, Real) and not isinstance(time, bool) for time in times)
    rise = numbers and times[0] >= 0 and all(before < after for before, after in pairwise(times))
    if not rise or len(times) != num_steps + 1:
        raise InputError(
            f"timesteps: expected {num_steps} (num_inference_steps) numbers that rise from at least 0 to below 1, for flow, "
            f"got {list(chosen)}"
        )
    return torch.tensor(times, dtype=torch.float32)


def flow_coefficients(times: Tensor) -> StepCoefficients:
    """Tabulate Euler steps between ``times`` [K + 1], see `StepCoefficients`.

    >>> flow_coefficients(flow_times(2)).clean_weight.tolist()
    [0.5, 1.0]
    """
    left = 1 - times[:-1]
    share = times.diff() / left
    none = torch.zeros_like(share)
    return StepCoefficients(
        noise_scale=-left,
        signal_scale=torch.ones_like(share),
        clean_weight=share,
        sample_weight=1 - share,
        eps_weight=none,
        previous_weight=none,
        earlier_weight=none,
        spread=none,
        clip=float("inf"),
    )
