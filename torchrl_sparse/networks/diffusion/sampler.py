"""Samplers: diffusers' DDPM and DDIM with every noise tensor handed in from outside.

Diffusion Policy (arXiv:2303.04137) trains with 100 DDPM steps (arXiv:2006.11239), the squared-cosine beta
schedule (arXiv:2102.09672), noise prediction and samples clipped to [-1, 1]. DDIM (arXiv:2010.02502, eta = 0)
samples the same network in any smaller number of steps, by default at diffusers' ``"leading"`` timesteps, as Diffusion
Policy does. Those lie evenly, end at 0 and, in few steps, begin far below the noise that the sample starts with (three of
a hundred: 66, 33, 0); ``timesteps`` puts them elsewhere, and `torchrl_sparse.training.diffusion.timesteps` finds where.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Sequence
from itertools import pairwise
from numbers import Integral
from typing import Any, Literal

import torch
from diffusers import DDIMScheduler, DDPMScheduler
from torch import Tensor

from torchrl_sparse.networks.diffusion.coefficients import StepCoefficients, step_coefficients
from torchrl_sparse.networks.sizes import check_size

__all__ = ["MAX_TRAIN_TIMESTEPS", "Sampler", "split_sampler", "timesteps_fall"]

MAX_TRAIN_TIMESTEPS = 10_000
"""Far beyond any diffusion model: tables as long as this are made of what a file asks for."""


class Sampler:
    """The denoising steps of one query, in execution order, and the noising of training.

    The schedulers of diffusers draw their own noise; here the caller passes it, so that two methods can share all
    noise of a query. Results equal theirs to the last bit. A sampler cannot be changed: engines keep tables of its steps.

    Args:
        kind: ``"ddpm"`` (ancestral, adds noise in every step but the last) or ``"ddim"`` (deterministic).
        num_inference_steps: denoising steps K of a query, 1 to ``num_train_timesteps``; None for one per entry of
            ``timesteps``, or without those for all training steps.
        num_train_timesteps: diffusion steps that the network was trained with, at most `MAX_TRAIN_TIMESTEPS`.
        timesteps: of DDIM's steps where they are not to be diffusers' own: K falling diffusion timesteps.

    Attributes:
        timesteps: i64 [K], the diffusion timestep of each denoising step; the first is the noisiest.
        previous_timesteps: the timestep that each of them leads to; -1, the clean sample, in the end.
        coefficients: the update of each denoising step in numbers, for loops without a sampler.
        scheduler: the diffusers scheduler.

    Raises:
        AttributeError: if an attribute is assigned.
        ValueError: on an unknown ``kind``, a number of steps out of range, or ``timesteps`` that do not fall or are not DDIM's.

    Examples:
        >>> sampler = Sampler("ddim", num_inference_steps=10)
        >>> sampler.timesteps.tolist()
        [90, 80, 70, 60, 50, 40, 30, 20, 10, 0]
        >>> import torch
        >>> sample = torch.zeros(1, 10, 7)
        >>> sampler.step(torch.zeros_like(sample), 0, sample).shape
        torch.Size([1, 10, 7])
        >>> Sampler("ddim", timesteps=[90, 50, 10]).name
        'ddim_90_50_10'
    """

    kind: str
    num_inference_steps: int
    num_train_timesteps: int
    scheduler: DDPMScheduler | DDIMScheduler
    timesteps: Tensor
    previous_timesteps: tuple[int, ...]
    coefficients: StepCoefficients

    def __init__(
        self,
        kind: Literal["ddpm", "ddim"] = "ddpm",
        num_inference_steps: int | None = None,
        num_train_timesteps: int = 100,
        *,
        timesteps: Sequence[int] | None = None,
    ) -> None:
        if kind not in ("ddpm", "ddim"):
            raise ValueError(f'kind must be "ddpm" or "ddim", got {kind!r}')
        if num_inference_steps is None:
            num_inference_steps = num_train_timesteps if timesteps is None else len(timesteps)
        check_size("num_train_timesteps", num_train_timesteps, MAX_TRAIN_TIMESTEPS)
        check_size("num_inference_steps", num_inference_steps, num_train_timesteps)
        scheduler = _scheduler(kind, num_inference_steps, num_train_timesteps)
        chosen = (
            None if timesteps is None else _checked(kind, timesteps, num_inference_steps, num_train_timesteps)
        )
        order = scheduler.timesteps.tolist() if chosen is None else chosen
        previous = (*order[1:], -1)
        vars(self).update(
            kind=kind,
            num_inference_steps=num_inference_steps,
            num_train_timesteps=num_train_timesteps,
            scheduler=scheduler,
            timesteps=torch.tensor(order),
            previous_timesteps=previous,
            coefficients=step_coefficients(
                kind, scheduler.alphas_cumprod, order, previous, clip=scheduler.config.clip_sample_range
            ),
            _chosen=chosen,
        )

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name}: expected a sampler to stay as it was made; make another Sampler")

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    @classmethod
    def from_name(
        cls, name: str, num_inference_steps: int | None = None, num_train_timesteps: int = 100
    ) -> Sampler:
        """Make the sampler of that `name`; without ``num_inference_steps`` that of the constructor without it.

        Raises:
            ValueError: if no sampler is called that, or not with so many steps.
        """
        kind, timesteps = split_sampler(name)
        return cls(kind, num_inference_steps, num_train_timesteps, timesteps=timesteps)

    @property
    def name(self) -> str:
        """``"ddpm"``, ``"ddim"``, or with its timesteps, where they were chosen, ``"ddim_90_50_10"``."""
        return "_".join([self.kind, *map(str, self._chosen or [])])

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments: ``Sampler(**sampler.config)`` is an equal sampler."""
        config = {
            "kind": self.kind,
            "num_inference_steps": self.num_inference_steps,
            "num_train_timesteps": self.num_train_timesteps,
        }
        return config if self._chosen is None else config | {"timesteps": list(self._chosen)}

    def step(self, eps: Tensor, k: int, sample: Tensor, noise_k: Tensor | None = None) -> Tensor:
        """Return the sample after denoising step ``k``.

        Args:
            eps: predicted noise [B, H, A].
            k: index of the denoising step in execution order, 0 .. K-1.
            sample: the sample that ``eps`` was predicted for, [B, H, A].
            noise_k: standard normal [B, H, A] of the transition from step ``k`` to ``k + 1``; not read by
                DDIM nor by the last step.

        Raises:
            IndexError: if ``k`` is not in 0..K-1.
            ValueError: if DDPM needs ``noise_k`` and it is None.
        """
        if not 0 <= k < self.num_inference_steps:
            raise IndexError(f"k must be in 0..{self.num_inference_steps - 1}, got {k}")
        if noise_k is None and self.coefficients.reads_noise(k):
            raise ValueError(f"DDPM step k={k} (timestep {int(self.timesteps[k])}) needs noise_k, got None")
        return self.coefficients.update(k, sample, eps, noise_k)

    def add_noise(self, clean: Tensor, noise: Tensor, timestep: Tensor) -> Tensor:
        """Return noisy actions ``sqrt(abar_t) clean + sqrt(1 - abar_t) noise`` for training.

        Args:
            clean: normalised actions [B, H, A].
            noise: standard normal [B, H, A].
            timestep: i64 [B], 0 .. num_train_timesteps - 1.
        """
        return self.scheduler.add_noise(clean, noise, timestep)

    def __repr__(self) -> str:
        return f"Sampler({', '.join(f'{name}={value!r}' for name, value in self.config.items())})"


def _scheduler(
    kind: str, num_inference_steps: int, num_train_timesteps: int
) -> DDPMScheduler | DDIMScheduler:
    common = {
        "num_train_timesteps": num_train_timesteps,
        "beta_schedule": "squaredcos_cap_v2",
        "clip_sample": True,
        "prediction_type": "epsilon",
    }
    if kind == "ddpm":
        scheduler = DDPMScheduler(variance_type="fixed_small", **common)
    else:
        scheduler = DDIMScheduler(set_alpha_to_one=True, steps_offset=0, **common)
    scheduler.set_timesteps(num_inference_steps)
    return scheduler


def _checked(kind: str, timesteps: Sequence[int], steps: int, num_train_timesteps: int) -> list[int]:
    chosen = list(timesteps)
    whole = all(isinstance(timestep, Integral) for timestep in chosen)
    falls = whole and timesteps_fall(chosen, num_train_timesteps)
    if kind != "ddim" or not falls or len(chosen) != steps:
        raise ValueError(
            f"timesteps: expected {steps} (num_inference_steps) whole numbers that fall from at most "
            f'{num_train_timesteps - 1} to at least 0, of kind "ddim", got {reprlib.repr(chosen)} of kind "{kind}"'
        )
    return [int(timestep) for timestep in chosen]


def timesteps_fall(timesteps: Sequence[int], num_train_timesteps: int) -> bool:
    """Return whether each timestep is below the last, from under ``num_train_timesteps`` down to at least 0.

    >>> timesteps_fall([99, 0], 100), timesteps_fall([100, 0], 100), timesteps_fall([9, 9], 100)
    (True, False, False)
    """
    return all(later < earlier for earlier, later in pairwise((num_train_timesteps, *timesteps, -1)))


def split_sampler(name: str) -> tuple[str, list[int] | None]:
    """Return the kind and the chosen timesteps of a `Sampler.name`.

    Raises:
        ValueError: if it is none.

    Examples:
        >>> split_sampler("ddim_90_50_10"), split_sampler("ddpm")
        (('ddim', [90, 50, 10]), ('ddpm', None))
    """
    match = re.fullmatch(r"(ddpm|ddim)((?:_\d+)*)", name) if isinstance(name, str) else None
    if match is None:
        raise ValueError(f"sampler: expected 'ddpm', 'ddim' or 'ddim_<t>_<t>...', got {name!r}")
    return match[1], [int(digits) for digits in match[2].split("_")[1:]] or None
