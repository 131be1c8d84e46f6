"""A sampler as eight coefficients per denoising step, so that a loop needs no scheduler.

With ``clip`` to [-1, 1], or another range, and the clean predictions of the two steps before, every sampler is one update::

    clean = clip((sample_share * sample - noise_scale * eps) / signal_scale)
    next  = clean_weight * clean + sample_weight * sample + eps_weight * eps
          + previous_weight * clean of the last step + earlier_weight * clean of the step before it
          + spread * gaussian

in diffusers' order of operations for DDPM (arXiv:2006.11239, Eq. 7: ``eps_weight = 0``) and DDIM (arXiv:2010.02502,
Eq. 12: ``sample_weight = 0``), which remember no step. `torchrl_sparse.networks.diffusion.multistep` has the weights of
those that do. ``eps`` is what the network predicts: noise, or the clean sample itself (``sample_share = 0``), or a
velocity (`torchrl_sparse.networks.diffusion.flow`). A `Guide` changes the clean prediction before it is used:
``clean + pull * (actions - clean)``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_sparse.networks.diffusion.multistep import MULTISTEP

__all__ = ["Guide", "StepCoefficients", "squared_cosine", "step_coefficients"]


class Guide(NamedTuple):
    """Actions toward which each step's clean predictions are guided, so that the other actions are denoised to fit them.

    Attributes:
        actions: normalised, f32 [B, H, A].
        pull: f32 [B, H, 1], how far each is drawn: 0 leaves it free, at 1 the call ends in ``actions``.
    """

    actions: Tensor
    pull: Tensor

    def rows(self, rows: Tensor) -> Guide:
        """Return the guide for the given rows, bool [B] or i64 [n]."""
        return Guide(self.actions[rows], self.pull[rows])


@dataclass(frozen=True)
class StepCoefficients:
    """Coefficients of every denoising step; each field but the last two is f32 [K], in execution order.

    Attributes:
        noise_scale: sqrt(1 - abar_t).
        signal_scale: sqrt(abar_t).
        clean_weight, sample_weight, eps_weight: of the clipped prediction, of the sample, of the predicted
            noise.
        previous_weight, earlier_weight: of the clipped predictions one and two steps before; 0 where none is read.
        spread: standard deviation of the noise that is added; 0 where none is.
        clip: largest absolute value of a clean action.
        sample_share: 0 where the network predicts the clean sample, which then is no part of the prediction; else 1.
    """

    noise_scale: Tensor
    signal_scale: Tensor
    clean_weight: Tensor
    sample_weight: Tensor
    eps_weight: Tensor
    previous_weight: Tensor
    earlier_weight: Tensor
    spread: Tensor
    clip: float
    sample_share: float = 1.0

    @property
    def history(self) -> int:
        """Number of earlier clean predictions that the steps read, 0 to 2."""
        return 2 if self.earlier_weight.any() else 1 if self.previous_weight.any() else 0

    def reads_noise(self, step: int) -> bool:
        """Return whether denoising step ``step`` adds noise."""
        return bool(self.spread[step] > 0)

    def clean(self, step: int, sample: Tensor, eps: Tensor, guide: Guide | None = None) -> Tensor:
        """Return the clipped clean prediction of denoising step ``step``; arguments as of :meth:`update`."""
        taken = sample if self.sample_share else 0.0
        clean = (taken - self.noise_scale[step] * eps) / self.signal_scale[step]
        clean = clean.clamp(-self.clip, self.clip)
        return clean if guide is None else clean + guide.pull * (guide.actions - clean)

    def update(
        self,
        step: int,
        sample: Tensor,
        eps: Tensor,
        gaussian: Tensor | None,
        cleans: Sequence[Tensor] = (),
        guide: Guide | None = None,
    ) -> Tensor:
        """Return the sample after denoising step ``step``.

        Args:
            step: in execution order.
            sample, eps: of one shape.
            gaussian: standard normal of the same shape; None where :meth:`reads_noise` is False.
            cleans: clipped predictions of the steps before, the latest first; those of weight 0 may be missing.
            guide: what the clean prediction is guided toward.
        """
        clean = self.clean(step, sample, eps, guide)
        result = self.clean_weight[step] * clean + self.sample_weight[step] * sample
        result = result + self.eps_weight[step] * eps
        for weight, clean in zip((self.previous_weight, self.earlier_weight), cleans, strict=False):
            result = result + weight[step] * clean
        return result + self.spread[step] * gaussian if self.reads_noise(step) else result

    def table(self) -> Tensor:
        """Return the eight coefficients of every step, f32 [K, 8], in the order of the fields."""
        return torch.stack([getattr(self, field.name) for field in fields(self)[:-2]], dim=1)


def squared_cosine(steps: int) -> Tensor:
    """Return the signal share after each training step, f32 [steps]: arXiv:2102.09672 Eq. 17, betas capped at 0.999.

    Diffusers has the same to the last bit, and takes two seconds to import.
    """

    signal = [math.cos((step / steps + 0.008) / 1.008 * math.pi / 2) ** 2 for step in range(steps + 1)]
    betas = [min(1 - after / before, 0.999) for before, after in pairwise(signal)]
    return (1.0 - torch.tensor(betas)).cumprod(0)


def step_coefficients(
    kind: str,
    alphas_cumprod: Tensor,
    timesteps: Sequence[int],
    previous_timesteps: Sequence[int],
    *,
    eta: float = 0.0,
    clip: float = 1.0,
    prediction: str = "epsilon",
) -> StepCoefficients:
    """Tabulate the coefficients of a sampler's steps.

    Args:
        kind: of the sampler, one of `torchrl_sparse.networks.diffusion.sampler.KINDS`.
        alphas_cumprod: abar of every diffusion timestep, f32 [T].
        timesteps: of each denoising step, K of them.
        previous_timesteps: the timestep that each of them leads to; -1 is the clean sample.
        eta: share of DDPM's noise that DDIM adds, in [0, 1].
        clip: largest absolute value of a clean action.
        prediction: ``"epsilon"``, the noise, or ``"sample"``, the clean sample.

    Examples:
        >>> coefficients = step_coefficients("ddim", torch.tensor([0.9, 0.5]), [1, 0], [0, -1])
        >>> coefficients.clean_weight[-1].item(), coefficients.eps_weight[-1].item()
        (1.0, 0.0)
    """
    abar = alphas_cumprod[list(timesteps)]
    # The clean sample, which a sampler ends on, has abar = 1.
    abar_next = torch.cat([alphas_cumprod, torch.ones(1)])[list(previous_timesteps)]
    if kind in MULTISTEP:
        weights = {name: weight.float() for name, weight in MULTISTEP[kind](abar, abar_next).items()}
    elif kind == "ddim":
        weights = _ddim(abar, abar_next, eta)
    else:
        weights = _ddpm(abar, abar_next)
    names = [field.name for field in fields(StepCoefficients)[2:-2]]
    all_weights = dict.fromkeys(names, torch.zeros(len(abar))) | weights
    noise, signal = (1 - abar) ** 0.5, abar**0.5
    if prediction == "epsilon":
        return StepCoefficients(noise, signal, **all_weights, clip=clip)
    # The noise that a clean prediction implies is (sample - signal * clean) / noise, before clean is clipped.
    implied = all_weights["eps_weight"] / noise
    all_weights |= {
        "sample_weight": all_weights["sample_weight"] + implied,
        "eps_weight": -implied * signal,
    }
    ones = torch.ones_like(noise)
    return StepCoefficients(-ones, ones, **all_weights, clip=clip, sample_share=0.0)


def _variance(abar: Tensor, abar_next: Tensor) -> Tensor:
    """DDPM's posterior variance between two timesteps ("fixed small"), f32 [K]."""
    return (1 - abar_next) / (1 - abar) * (1 - abar / abar_next)


def _ddpm(abar: Tensor, abar_next: Tensor) -> dict[str, Tensor]:
    alpha = abar / abar_next
    # diffusers keeps the variance away from 0; and no noise is added to the clean sample.
    variance = _variance(abar, abar_next).clamp(min=1e-20)
    return {
        "clean_weight": abar_next**0.5 * (1 - alpha) / (1 - abar),
        "sample_weight": alpha**0.5 * (1 - abar_next) / (1 - abar),
        "spread": torch.where(abar_next < 1, variance**0.5, 0.0),
    }


def _ddim(abar: Tensor, abar_next: Tensor, eta: float) -> dict[str, Tensor]:
    spread = eta * _variance(abar, abar_next) ** 0.5
    return {
        "clean_weight": abar_next**0.5,
        "eps_weight": (1 - abar_next - spread**2).clamp(min=0) ** 0.5,  # rounding may lead below 0
        "spread": spread,
    }
