"""Grammar of sampler names in methods, saved schedules and pruners, and options.

::

    KIND [STEPS] [_SPACING] [_etaETA]     ddpm10   ddpm10_trailing   ddpm2_logsnr   ddim10_eta0.5   unipc10
    KIND _T _T ...          [_etaETA]     ddpm_82_14   ddim_90_50_10   ddim_82_14_eta1

KIND is one of :data:`KINDS`, SPACING one of `torchrl_sparse.networks.diffusion.spacing.SPACINGS`, ``leading`` where
none is written. The timesteps T fall; those of ``flow`` are times that rise from 0, ``flow_0_0.4``. ETA in [0, 1] is
DDIM's. Files that keep the number of steps beside the name
leave STEPS out (``ddim``, ``ddpm_logsnr``).
"""

from __future__ import annotations

import re
import reprlib
from dataclasses import dataclass

import numpy as np

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.spacing import SPACINGS

__all__ = ["CHAIN_PATTERN", "KINDS", "SamplerName"]

KINDS = ("ddpm", "ddim", "dpmpp2m", "sde2m", "unipc", "flow")
_KIND, _SPACING = (rf"(?:{'|'.join(words)})" for words in (KINDS, SPACINGS))
_STEPS, _TIMESTEPS, _ETA = r"[1-9]\d{0,4}", r"(?:_\d{1,5}(?:\.\d{1,9})?)+", r"_eta\d(?:\.\d{1,20})?"

CHAIN_PATTERN = rf"{_KIND}(?:{_STEPS}(?:_{_SPACING})?|{_TIMESTEPS})(?:{_ETA})?"
"""Regular expression of the names that say how many steps there are; it has no groups."""

_NAME = re.compile(rf"({_KIND})(?:({_STEPS})?(?:_({_SPACING}))?|({_TIMESTEPS}))({_ETA})?")


@dataclass(frozen=True)
class SamplerName:
    """Parsed sampler name.

    Attributes:
        kind: one of :data:`KINDS`.
        num_inference_steps: STEPS; None where they are not written.
        timesteps: chosen ones; None where a spacing decides.
        spacing: ``"leading"`` where none is written.
        eta: 0 where none is written.

    Examples:
        >>> SamplerName.parse("ddim10_eta0.5")
        SamplerName(kind='ddim', num_inference_steps=10, timesteps=None, spacing='leading', eta=0.5)
        >>> str(SamplerName("ddpm", timesteps=(82, 14))), str(SamplerName("ddpm", 2, spacing="logsnr"))
        ('ddpm_82_14', 'ddpm2_logsnr')
    """

    kind: str
    num_inference_steps: int | None = None
    timesteps: tuple[float, ...] | None = None
    spacing: str = "leading"
    eta: float = 0.0

    @classmethod
    def parse(cls, text: str) -> SamplerName:
        """Parse ``text``; raise InputError unless it follows the module's grammar."""
        match = _NAME.fullmatch(text) if isinstance(text, str) else None
        if match is not None and match[1] != "flow" and "." in (match[4] or ""):
            match = None
        if match is None:
            raise InputError(
                f"sampler: expected KIND[STEPS][_SPACING][_etaETA] or KIND_T_T...[_etaETA] of kind {', '.join(KINDS)} "
                f"and spacing {', '.join(SPACINGS)}, got {reprlib.repr(text)}"
            )
        kind, steps, spacing, timesteps, eta = match.groups()
        return cls(
            kind,
            int(steps) if steps else None,
            tuple(float(t) if "." in t else int(t) for t in timesteps.split("_")[1:]) if timesteps else None,
            spacing or "leading",
            float(eta.removeprefix("_eta")) if eta else 0.0,
        )

    def __str__(self) -> str:
        parts = [f"{self.kind}{self.num_inference_steps or ''}", *map(_short, self.timesteps or ())]
        if self.spacing != "leading":
            parts.append(self.spacing)
        if self.eta:
            parts.append(f"eta{_short(self.eta)}")
        return "_".join(parts)


def _short(number: float) -> str:
    return np.format_float_positional(number, trim="-")
