"""Weights of multistep solvers, which reuse earlier clean predictions, as diffusers defines them, in float64.

With ``alpha = sqrt(abar)``, ``sigma = sqrt(1 - abar)``, ``lambda = log(alpha / sigma)``, s the timestep of a step, t the
one that it leads to, ``h = lambda_t - lambda_s`` and ``q = h / h of the step before``, a step of second order goes along
``D = clean + (clean - previous clean) q / 2``, one of first order along ``D = clean``::

    dpmpp2m  next = sigma_t / sigma_s sample + alpha_t (1 - e^-h) D        DPM-Solver++ (2M), arXiv:2211.01095
    sde2m    next = sigma_t / sigma_s e^-h sample + alpha_t (1 - e^-2h) D
                    + sigma_t sqrt(1 - e^-2h) gaussian                     its SDE form, "sde-dpmsolver++"
    unipc    dpmpp2m of the corrected sample                               UniPC, B2(h), arXiv:2302.04867

First and last step are of first order. UniPC first corrects the sample with the prediction that was made from it::

    corrected = sample + g (rho (clean - previous clean) + rho' (previous clean - earlier clean))
    g = alpha_s (1 - e^-h of the step before)

with ``rho = 1/2, rho' = 0`` in the second step; later they solve UniC's two order conditions.

What follows from the equations: the first-order step of ``sde2m`` is DDPM's, and that of the others DDIM's wherever
nothing is clipped (where it is, DDIM keeps the predicted noise and they take it from the clipped prediction). So in
two steps ``sde2m`` is DDPM, and ``unipc`` is ``dpmpp2m``.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["MULTISTEP"]

Weights = dict[str, Tensor]


class _Levels:
    """Numbers that the solvers use, f64 [K] each: ``log_ratio`` is h, ``slope`` is q / 2, or 0 in steps of first order."""

    def __init__(self, abar: Tensor, abar_next: Tensor) -> None:
        alpha, sigma = abar.double().sqrt(), (1 - abar.double()).sqrt()
        self.alpha, self.alpha_next = alpha, abar_next.double().sqrt()
        sigma_next = (1 - abar_next.double()).sqrt()
        self.sigma_next, self.sigma_ratio = sigma_next, sigma_next / sigma
        self.log_ratio = (self.alpha_next / sigma_next).log() - (alpha / sigma).log()
        self.growth = self.log_ratio / _before(self.log_ratio)  # q
        self.growth[:1] = 0
        self.slope = self.growth / 2
        self.slope[-1:] = 0


def _before(values: Tensor) -> Tensor:
    """Return the values of the step before each; 0 before the first."""
    return torch.cat([torch.zeros_like(values[:1]), values[:-1]])


def _along(gain: Tensor, slope: Tensor) -> Weights:
    return {"clean_weight": gain * (1 + slope), "previous_weight": -gain * slope}


def _dpmpp2m(abar: Tensor, abar_next: Tensor) -> Weights:
    at = _Levels(abar, abar_next)
    gain = -at.alpha_next * torch.expm1(-at.log_ratio)
    return {"sample_weight": at.sigma_ratio, **_along(gain, at.slope)}


def _sde2m(abar: Tensor, abar_next: Tensor) -> Weights:
    at = _Levels(abar, abar_next)
    share = -torch.expm1(-2 * at.log_ratio)
    return {
        "sample_weight": at.sigma_ratio * torch.exp(-at.log_ratio),
        "spread": at.sigma_next * share.sqrt(),
        **_along(at.alpha_next * share, at.slope),
    }


def _unipc(abar: Tensor, abar_next: Tensor) -> Weights:
    at, weights = _Levels(abar, abar_next), _dpmpp2m(abar, abar_next)
    rho, rho_earlier = _corrector(_before(at.log_ratio), _before(at.growth))
    gain = (
        -at.alpha * torch.expm1(-_before(at.log_ratio)) * at.sigma_ratio
    )  # of a corrected sample, in the next one
    return {
        "sample_weight": weights["sample_weight"],
        "clean_weight": weights["clean_weight"] + gain * rho,
        "previous_weight": weights["previous_weight"] + gain * (rho_earlier - rho),
        "earlier_weight": -gain * rho_earlier,
    }


def _corrector(log_ratio: Tensor, growth: Tensor) -> tuple[Tensor, Tensor]:
    """Solve UniC for rho and rho' of each step, given h and q of the step before it.

    The order conditions are ``a + rho = b1`` and ``rho - a / q = b2``; the predictor already went ``1/2`` along the older
    difference.
    """
    base = torch.expm1(-log_ratio)
    phi2 = base / -log_ratio - 1
    b1, b2 = phi2 / base, (phi2 / -log_ratio - 0.5) * 2 / base
    older = (b1 - b2) / (1 + 1 / growth)
    second = torch.arange(len(growth)) >= 2
    first = torch.arange(len(growth)) == 1
    rho = torch.where(second, b1 - older, torch.where(first, 0.5, 0.0))
    return rho, torch.where(second, (older - 0.5) * growth, 0.0)


MULTISTEP = {"dpmpp2m": _dpmpp2m, "sde2m": _sde2m, "unipc": _unipc}
"""Kind of sampler -> its weights of each step, from abar of the timesteps and of those that they lead to."""
