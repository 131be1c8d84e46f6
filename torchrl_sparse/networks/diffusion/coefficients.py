"""The scheduler as five numbers for each denoising step, for loops without a scheduler.

With ``clip`` to [-1, 1], both samplers are one update, in diffusers' order of operations::

    clean = clip((sample - noise_scale * eps) / signal_scale)
    next  = clean_weight * clean + sample_weight * sample + eps_weight * eps + spread * gaussian

DDPM (arXiv:2006.11239, Eq. 7) has ``eps_weight = 0``; DDIM (arXiv:2010.02502, Eq. 12, eta = 0) has
``sample_weight = spread = 0``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["StepCoefficients", "step_coefficients"]


@dataclass(frozen=True)
class StepCoefficients:
    """The update of every denoising step; each field but ``clip`` is f32 [K], in execution order.

    Attributes:
        noise_scale: sqrt(1 - abar_t).
        signal_scale: sqrt(abar_t).
        clean_weight, sample_weight, eps_weight: of the clipped prediction, of the sample, of the predicted
            noise.
        spread: standard deviation of the noise that is added; 0 in the last step.
        clip: largest absolute value of a clean action.
    """

    noise_scale: Tensor
    signal_scale: Tensor
    clean_weight: Tensor
    sample_weight: Tensor
    eps_weight: Tensor
    spread: Tensor
    clip: float

    def update(self, step: int, sample: Tensor, eps: Tensor, gaussian: Tensor | None) -> Tensor:
        """The sample after denoising step ``step``, to the last bit that of ``Sampler.step``.

        Args:
            step: in execution order.
            sample, eps: of one shape.
            gaussian: of the same shape; not read by DDIM, None in the last step.
        """
        clean = (sample - self.noise_scale[step] * eps) / self.signal_scale[step]
        clean = clean.clamp(-self.clip, self.clip)
        result = self.clean_weight[step] * clean + self.sample_weight[step] * sample
        result = result + self.eps_weight[step] * eps
        return result if gaussian is None else result + self.spread[step] * gaussian

    def columns(self) -> tuple[list[float], ...]:
        """The first five fields as Python floats, which hold their float32 values exactly."""
        fields = (self.noise_scale, self.signal_scale, self.clean_weight, self.sample_weight, self.eps_weight)
        return tuple(field.tolist() for field in fields)


def step_coefficients(sampler: Sampler) -> StepCoefficients:
    """Tabulate ``sampler``.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> coefficients = step_coefficients(Sampler("ddim", 10))
        >>> coefficients.clean_weight[-1].item(), coefficients.eps_weight[-1].item()
        (1.0, 0.0)
    """
    scheduler = sampler.scheduler
    timesteps = sampler.timesteps.tolist()
    one = torch.tensor(1.0)
    # DDIM ends on diffusers' final_alpha_cumprod, which Sampler sets to one, as DDPM does.
    alpha_prod = scheduler.alphas_cumprod[timesteps]
    alpha_prod_prev = torch.stack(
        [scheduler.alphas_cumprod[t] if t >= 0 else one for t in sampler.previous_timesteps]
    )
    beta_prod, beta_prod_prev = 1 - alpha_prod, 1 - alpha_prod_prev
    zeros = torch.zeros(len(timesteps))
    if sampler.kind == "ddim":
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
    return StepCoefficients(
        beta_prod**0.5, alpha_prod**0.5, *weights, clip=scheduler.config.clip_sample_range
    )
