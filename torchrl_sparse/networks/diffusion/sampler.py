"""Samplers: diffusers' own, with all noise passed in and the predicted clean sample always clipped.

Diffusion Policy (arXiv:2303.04137) trains with 100 steps, the squared-cosine beta schedule (arXiv:2102.09672), noise prediction
and samples clipped to [-1, 1]. The same network is sampled by

======== ============ =====================================================================================
kind     noise        method
======== ============ =====================================================================================
ddpm     every step   ancestral (arXiv:2006.11239); posterior variance of any two timesteps ("fixed small")
ddim     none, or eta arXiv:2010.02502; ``eta`` times DDPM's standard deviation, fresh in every step
dpmpp2m  none         DPM-Solver++ (2M), arXiv:2211.01095
sde2m    every step   its SDE form, "sde-dpmsolver++"
unipc    none         UniPC of order 2, B2(h), arXiv:2302.04867
flow     none         Euler steps of flow matching, `torchrl_sparse.networks.diffusion.flow`
======== ============ =====================================================================================

in any number of steps, at the timesteps of a spacing (`torchrl_sparse.networks.diffusion.spacing`) or at any that
fall. DDPM and DDIM equal diffusers' classes to the last bit; the solvers equal theirs where nothing is clipped, since
diffusers' solvers never clip. The equations are in `torchrl_sparse.networks.diffusion.coefficients` and
`torchrl_sparse.networks.diffusion.multistep`, the names in `torchrl_sparse.networks.diffusion.naming`.

Two steps are not new: GDP (arXiv:2510.21991) chooses among a population of chains of two network calls, MIP
(arXiv:2512.01809) trains two steps of regression, and Hydra-DP3 (arXiv:2605.01581) takes two of DDIM.
"""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import Guide, StepCoefficients
from torchrl_sparse.networks.diffusion.naming import KINDS, SamplerName
from torchrl_sparse.networks.diffusion.steps import check_clip, check_prediction, sampler_steps
from torchrl_sparse.networks.sizes import check_size

__all__ = ["MAX_TRAIN_TIMESTEPS", "Sampler"]

MAX_TRAIN_TIMESTEPS = 10_000
"""Far beyond any diffusion model: tables as long as this are made of what a file asks for."""


class Sampler:
    """Denoising steps of one policy call, in execution order, and the noising used in training.

    The schedulers of diffusers draw their own noise; here the caller passes it, so that two methods can share all
    noise of a call. A sampler cannot be changed: engines keep tables of its steps.

    Args:
        kind: ``"ddpm"``, ``"ddim"``, ``"dpmpp2m"``, ``"sde2m"``, ``"unipc"`` or ``"flow"``, see the module.
        num_inference_steps: denoising steps K of a call, 1 to ``num_train_timesteps``; None for one per entry of
            ``timesteps``, or without those for all training steps.
        num_train_timesteps: diffusion steps that the network was trained with, at most `MAX_TRAIN_TIMESTEPS`.
        timesteps: K falling diffusion timesteps, where no spacing shall decide; of flow, K rising times in [0, 1).
        eta: of DDIM, in [0, 1]: 0 is deterministic, 1 has DDPM's variance, and is DDPM where nothing is clipped.
        spacing: ``"leading"``, ``"trailing"``, ``"linspace"`` or ``"logsnr"``, see
            :mod:`~torchrl_sparse.networks.diffusion.spacing`; a warning says where one begins far from noise.
        clip_sample_range: largest absolute value of a predicted clean action, as in diffusers; 1 for normalised actions, None
            for any. Flow clips nothing.
        prediction: what the network predicts, ``"epsilon"``, the noise, or ``"sample"``, the clean sample; of flow
            ``"velocity"``. None is the first of those that the kind has.

    Attributes:
        timesteps: i64 [K], the diffusion timestep of each denoising step; the first is the noisiest. Of flow f32, times.
        previous_timesteps: the timestep that each of them leads to; -1, the clean sample, in the end.
        alphas_cumprod: abar of every diffusion timestep, f32 [T].
        coefficients: the update of each denoising step in numbers, for loops without a sampler.

    Raises:
        AttributeError: if an attribute is assigned.
        InputError: naming the argument: an unknown ``kind`` or ``spacing``, a number of steps out of range,
            ``timesteps`` that do not fall, an ``eta`` out of [0, 1] or of another kind than DDIM, a
            ``clip_sample_range`` that is not positive.

    Examples:
        >>> import torch
        >>> sampler = Sampler("ddim", num_inference_steps=10)
        >>> sampler.timesteps.tolist()
        [90, 80, 70, 60, 50, 40, 30, 20, 10, 0]
        >>> sample = torch.zeros(1, 10, 7)
        >>> sampler.step(torch.zeros_like(sample), 0, sample).shape
        torch.Size([1, 10, 7])
        >>> Sampler("ddpm", timesteps=[82, 14]).name, Sampler("ddpm", 2, spacing="logsnr").timesteps.tolist()
        ('ddpm_82_14', [91, 41])
    """

    kind: str
    num_inference_steps: int
    num_train_timesteps: int
    eta: float
    spacing: str
    clip_sample_range: float | None
    prediction: str
    timesteps: Tensor
    previous_timesteps: tuple[int, ...]
    alphas_cumprod: Tensor
    coefficients: StepCoefficients
    _chosen: tuple[float, ...] | None

    def __init__(
        self,
        kind: str = "ddpm",
        num_inference_steps: int | None = None,
        num_train_timesteps: int = 100,
        *,
        timesteps: Sequence[float] | None = None,
        eta: float = 0.0,
        spacing: str = "leading",
        clip_sample_range: float | None = 1.0,
        prediction: str | None = None,
    ) -> None:
        if kind not in KINDS:
            raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
        if num_inference_steps is None:
            num_inference_steps = num_train_timesteps if timesteps is None else len(timesteps)
        check_size("num_train_timesteps", num_train_timesteps, MAX_TRAIN_TIMESTEPS)
        flows = kind == "flow"
        check_size(
            "num_inference_steps", num_inference_steps, MAX_TRAIN_TIMESTEPS if flows else num_train_timesteps
        )
        if not isinstance(eta, Real) or not 0 <= eta <= 1 or (eta and kind != "ddim"):
            raise InputError(
                f'eta: expected a number in [0, 1], other than 0 of kind "ddim" alone, got {eta!r} of kind "{kind}"'
            )
        if timesteps is not None and spacing != "leading":
            raise InputError(f"spacing: expected none beside timesteps, got {spacing!r}")
        vars(self).update(
            kind=kind,
            num_inference_steps=num_inference_steps,
            num_train_timesteps=num_train_timesteps,
            eta=float(eta),
            spacing=spacing,
            clip_sample_range=check_clip(kind, clip_sample_range),
            prediction=check_prediction(kind, prediction),
            _chosen=None if timesteps is None else tuple(timesteps),
        )
        vars(self).update(sampler_steps(self, self._chosen))

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name}: expected a sampler to stay as it was made; make another Sampler")

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    @classmethod
    def from_name(
        cls, name: str, num_inference_steps: int | None = None, num_train_timesteps: int = 100
    ) -> Sampler:
        """Make a sampler from its name, see :mod:`~torchrl_sparse.networks.diffusion.naming`.

        Args:
            name: what :attr:`name` says, or with its number of steps, e.g. ``"ddpm10"``.
            num_inference_steps: steps of a name that does not say how many; None as in the constructor.
            num_train_timesteps: diffusion steps that the network was trained with.

        Raises:
            InputError: if no sampler is called that, or not with so many steps.
        """
        parts = SamplerName.parse(name)
        written, asked = parts.num_inference_steps, num_inference_steps
        if None not in (written, asked) and written != asked:
            raise InputError(f"num_inference_steps: expected those of sampler {name!r}, got {asked}")
        options: dict[str, Any] = {"timesteps": parts.timesteps, "eta": parts.eta, "spacing": parts.spacing}
        return cls(parts.kind, written or asked, num_train_timesteps, **options)

    def variant(self, kind: str = "ddpm", num_inference_steps: int | None = None, **options: Any) -> Sampler:
        """Return another sampler for the same network, with the training settings :attr:`trained` unchanged.

        Arguments and errors are those of the constructor.

        >>> Sampler("ddpm", 50, 50, clip_sample_range=2.0).variant("ddim", 10)
        Sampler(kind='ddim', num_inference_steps=10, num_train_timesteps=50, clip_sample_range=2.0)
        """
        return Sampler(kind, num_inference_steps, **self.trained | options)

    def variant_named(self, name: str, num_inference_steps: int | None = None) -> Sampler:
        """Return the :meth:`variant` with that name; arguments and errors are those of :meth:`from_name`.

        >>> Sampler("ddpm", 50, 50).variant_named("ddim10").num_train_timesteps
        50
        """
        named = Sampler.from_name(name, num_inference_steps, self.num_train_timesteps)
        return Sampler(**named.config | self.trained)

    @property
    def trained(self) -> dict[str, Any]:
        """The arguments that follow from how the network was trained: ``num_train_timesteps``, ``clip_sample_range``, and
        ``prediction`` where that is not the noise."""
        trained = {
            "num_train_timesteps": self.num_train_timesteps,
            "clip_sample_range": self.clip_sample_range,
        }
        return trained if self.prediction == "epsilon" else trained | {"prediction": self.prediction}

    def last_steps(self, number: int) -> Sampler:
        """Return a sampler of the last ``number`` steps alone, 1 to K, with unchanged coefficients.

        Multistep solvers start again: their first step is of first order.

        >>> Sampler("ddpm", timesteps=[82, 41, 14]).last_steps(2).name
        'ddpm_41_14'
        """
        check_size("number", number, self.num_inference_steps)
        if number == self.num_inference_steps:
            return self
        timesteps = self.timesteps[-number:].tolist()
        return self.variant(self.kind, timesteps=timesteps, eta=self.eta)

    @property
    def name(self) -> str:
        """Name without the number of steps: ``"ddpm"``, ``"ddpm_logsnr"``, ``"ddim_90_50_10"``."""
        return str(SamplerName(self.kind, None, self._chosen, self.spacing, self.eta))

    @property
    def config(self) -> dict[str, Any]:
        """Constructor arguments: ``Sampler(**sampler.config)`` is an equal sampler."""
        config = {
            "kind": self.kind,
            "num_inference_steps": self.num_inference_steps,
            "num_train_timesteps": self.num_train_timesteps,
        }
        if self._chosen is not None:
            config["timesteps"] = list(self._chosen)
        defaults = {"eta": 0.0, "spacing": "leading", "clip_sample_range": 1.0, "prediction": "epsilon"}
        if self.kind == "flow":
            defaults |= {"clip_sample_range": None, "prediction": "velocity"}
        return config | {
            name: found for name, default in defaults.items() if (found := vars(self)[name]) != default
        }

    def step(
        self,
        eps: Tensor,
        k: int,
        sample: Tensor,
        noise_k: Tensor | None = None,
        cleans: Sequence[Tensor] = (),
        guide: Guide | None = None,
    ) -> Tensor:
        """Return the sample after denoising step ``k``.

        Args:
            eps: predicted noise [B, H, A].
            k: index of the denoising step in execution order, 0 .. K-1.
            sample: the sample that ``eps`` was predicted for, [B, H, A].
            noise_k: standard normal [B, H, A] of the transition from step ``k`` to ``k + 1``; not read by
                deterministic samplers nor by the last step.
            cleans: what :meth:`remember` returned after the step before; empty before the first.
            guide: what the clean prediction is guided toward, see `Guide`.

        Raises:
            IndexError: if ``k`` is not in 0..K-1.
            InputError: if the step needs ``noise_k`` or ``cleans`` and they are missing.
        """
        if not 0 <= k < self.num_inference_steps:
            raise IndexError(f"k must be in 0..{self.num_inference_steps - 1}, got {k}")
        if noise_k is None and self.coefficients.reads_noise(k):
            raise InputError(
                f"noise_k: expected noise for step k={k} of {self.name} (timestep {int(self.timesteps[k])}), got None"
            )
        if len(cleans) < (needed := min(k, self.coefficients.history)):
            raise InputError(
                f"cleans: expected {needed} predictions before step k={k} of {self.name}, got {len(cleans)}"
            )
        return self.coefficients.update(k, sample, eps, noise_k, cleans, guide)

    def remember(
        self, cleans: Sequence[Tensor], eps: Tensor, k: int, sample: Tensor, guide: Guide | None = None
    ) -> tuple[Tensor, ...]:
        """Return the clean predictions that the step after ``k`` reads, latest first; empty if it reads none.

        Arguments: :meth:`step`.
        """
        if not self.coefficients.history:
            return ()
        return (self.coefficients.clean(k, sample, eps, guide), *cleans)[: self.coefficients.history]

    def add_noise(self, clean: Tensor, noise: Tensor, timestep: Tensor) -> Tensor:
        """Return noisy actions ``sqrt(abar_t) clean + sqrt(1 - abar_t) noise`` for training; factors are computed in f32.

        Args:
            clean: normalised actions [B, H, A].
            noise: standard normal [B, H, A].
            timestep: i64 [B], 0 .. num_train_timesteps - 1; of flow f32, times.
        """
        if self.kind == "flow":
            time = timestep.to(clean)[:, None, None]
            return time * clean + (1 - time) * noise
        abar = self.alphas_cumprod.to(clean.device)[timestep][:, None, None]
        return (abar**0.5).to(clean) * clean + ((1 - abar) ** 0.5).to(clean) * noise

    def __repr__(self) -> str:
        return f"Sampler({', '.join(f'{name}={value!r}' for name, value in self.config.items())})"
