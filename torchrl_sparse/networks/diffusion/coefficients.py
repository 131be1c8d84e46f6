"""A sampler as six numbers for each denoising step, so that a loop needs no scheduler.

With ``clip`` to [-1, 1], DDPM and DDIM are one update, in diffusers' order of operations::

    clean = clip((sample - noise_scale * eps) / signal_scale)
    next  = clean_weight * clean + sample_weight * sample + eps_weight * eps + spread * gaussian

DDPM (arXiv:2006.11239, Eq. 7) has ``eps_weight = 0``; DDIM (arXiv:2010.02502, Eq. 12, eta = 0) has
``sample_weight = spread = 0``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

__all__ = ["StepCoefficients", "step_coefficients"]


@dataclass(frozen=True)
class StepCoefficients:
    """The update of every denoising step; each field but ``clip`` is f32 [K], in execution order.

    Attributes:
        noise_scale: sqrt(1 - abar_t).
        signal_scale: sqrt(abar_t).
        clean_weight, sample_weight, eps_weight: of the clipped prediction, of the sample, of the predicted
            noise.
        spread: standard deviation of the noise that is added; 0 where none is.
        clip: largest absolute value of a clean action.
    """

    noise_scale: Tensor
    signal_scale: Tensor
    clean_weight: Tensor
    sample_weight: Tensor
    eps_weight: Tensor
    spread: Tensor
    clip: float

    def reads_noise(self, step: int) -> bool:
        """Return whether denoising step ``step`` adds noise."""
        return bool(self.spread[step] > 0)

    def update(self, step: int, sample: Tensor, eps: Tensor, gaussian: Tensor | None) -> Tensor:
        """Return the sample after denoising step ``step``.

        Args:
            step: in execution order.
            sample, eps: of one shape.
            gaussian: standard normal of the same shape; None where :meth:`reads_noise` is False.
        """
        clean = (sample - self.noise_scale[step] * eps) / self.signal_scale[step]
        clean = clean.clamp(-self.clip, self.clip)
        result = self.clean_weight[step] * clean + self.sample_weight[step] * sample
        result = result + self.eps_weight[step] * eps
        return result + self.spread[step] * gaussian if self.reads_noise(step) else result

    def table(self) -> Tensor:
        """Return the six coefficients of every step, f32 [K, 6], in the order of the fields."""
        return torch.stack(
            [
                self.noise_scale,
                self.signal_scale,
                self.clean_weight,
                self.sample_weight,
                self.eps_weight,
                self.spread,
            ],
            dim=1,
        )


def step_coefficients(
    kind: Literal["ddpm", "ddim"],
    alphas_cumprod: Tensor,
    timesteps: Sequence[int],
    previous_timesteps: Sequence[int],
    *,
    clip: float = 1.0,
) -> StepCoefficients:
    """Tabulate the steps of a sampler.

    Args:
        kind: of the sampler.
        alphas_cumprod: abar of every diffusion timestep, f32 [T].
        timesteps: of each denoising step, K of them.
        previous_timesteps: the timestep that each of them leads to; -1 is the clean sample.
        clip: largest absolute value of a clean action.

    Examples:
        >>> coefficients = step_coefficients("ddim", torch.tensor([0.9, 0.5]), [1, 0], [0, -1])
        >>> coefficients.clean_weight[-1].item(), coefficients.eps_weight[-1].item()
        (1.0, 0.0)
    """
    alpha_prod = alphas_cumprod[list(timesteps)]
    # The clean sample, which a sampler ends on, has abar = 1.
    alpha_prod_prev = torch.cat([alphas_cumprod, torch.ones(1)])[list(previous_timesteps)]
    beta_prod, beta_prod_prev = 1 - alpha_prod, 1 - alpha_prod_prev
    zeros = torch.zeros(len(timesteps))
    if kind == "ddim":
        weights = alpha_prod_prev**0.5, zeros, beta_prod_prev**0.5, zeros
    else:
        alpha = alpha_prod / alpha_prod_prev
        # diffusers keeps the variance away from 0; and adds no noise at all at timestep 0.
        variance = (beta_prod_prev / beta_prod * (1 - alpha)).clamp(min=1e-20)
        spread = torch.where(torch.tensor(timesteps) > 0, variance**0.5, zeros)
        weights = (
            alpha_prod_prev**0.5 * (1 - alpha) / beta_prod,
            alpha**0.5 * beta_prod_prev / beta_prod,
            zeros,
            spread,
        )
    return StepCoefficients(beta_prod**0.5, alpha_prod**0.5, *weights, clip=clip)
