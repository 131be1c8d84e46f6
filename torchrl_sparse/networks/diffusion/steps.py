"""From a sampler's arguments to its steps: what its network predicts, at which timesteps, and the coefficients of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import squared_cosine, step_coefficients
from torchrl_sparse.networks.diffusion.flow import flow_coefficients, flow_times
from torchrl_sparse.networks.diffusion.multistep import MULTISTEP
from torchrl_sparse.networks.diffusion.spacing import check_timesteps, spaced_timesteps

__all__ = ["check_clip", "check_prediction", "sampler_steps"]

_MAX_CLIP = 1e6
_FLOW, _DIFFUSION = ("velocity",), ("epsilon", "sample")


def check_prediction(kind: str, prediction: str | None) -> str:
    """Return what networks of a kind of sampler predict, the first of those that it has where None is asked for.

    >>> check_prediction("ddim", None), check_prediction("flow", None)
    ('epsilon', 'velocity')
    """
    known = _FLOW if kind == "flow" else _DIFFUSION
    prediction = known[0] if prediction is None else prediction
    if prediction not in known:
        expected = " or ".join(f'"{name}"' for name in known)
        raise InputError(f'prediction: expected {expected} of kind "{kind}", got {prediction!r}')
    return prediction


def check_clip(kind: str, clip_sample_range: float | None) -> float | None:
    """Return the largest absolute value of a clean action, None for any, as of flow; ValueError unless it is one."""
    if kind == "flow" or clip_sample_range is None:
        return None
    if not isinstance(clip_sample_range, Real) or not 0 < clip_sample_range <= _MAX_CLIP:
        raise InputError(
            f"clip_sample_range: expected a number above 0, at most {_MAX_CLIP:g}, or None, got {clip_sample_range!r}"
        )
    return float(clip_sample_range)


def sampler_steps(sampler: Any, chosen: Sequence[float] | None) -> dict[str, Any]:
    """Return the attributes of a `Sampler` that follow from its arguments, which it has already.

    Args:
        sampler: with ``kind``, ``num_inference_steps`` and all other arguments.
        chosen: timesteps, or None where the spacing decides.

    Raises:
        InputError: naming the argument.
    """
    kind, num_steps, spacing = sampler.kind, sampler.num_inference_steps, sampler.spacing
    if kind == "flow":
        if spacing != "leading":
            raise InputError(f'spacing: expected none of kind "flow", whose steps are even, got {spacing!r}')
        times = flow_times(num_steps, chosen)
        return {"timesteps": times[:-1], "coefficients": flow_coefficients(times)}
    alphas_cumprod = squared_cosine(sampler.num_train_timesteps)
    if chosen is None:
        order = spaced_timesteps(spacing, num_steps, alphas_cumprod, without_last=kind in MULTISTEP)
    else:
        order = check_timesteps(chosen, num_steps, sampler.num_train_timesteps)
        chosen = tuple(order)
    previous = (*order[1:], -1)
    clip = math.inf if sampler.clip_sample_range is None else sampler.clip_sample_range
    options: dict[str, Any] = {"eta": sampler.eta, "clip": clip, "prediction": sampler.prediction}
    return {
        "timesteps": torch.tensor(order),
        "previous_timesteps": previous,
        "alphas_cumprod": alphas_cumprod,
        "coefficients": step_coefficients(kind, alphas_cumprod, order, previous, **options),
        "_chosen": chosen,
    }
