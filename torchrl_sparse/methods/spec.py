"""Methods as values, with the label grammar from which they are parsed.

::

    PLANNER | SAMPLER[_warmN|_rtc] | uniformN[_SAMPLER[_warmN|_rtc]]
    [_everyN] [_ofS] [_ensembled] [_ahead] [:WEIGHTS] [@RATE | @COARSE-FINE | @METHOD]

SAMPLER is written as :mod:`torchrl_sparse.networks.diffusion.naming` says: ``ddpm5_logsnr``, ``uniform2_ddim10``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.naming import CHAIN_PATTERN

__all__ = ["WEIGHTS", "MethodSpec"]

WEIGHTS = ("bf16", "int8")

_COUNT, _NUMBER = r"([1-9]\d*)", r"(\d*\.?\d+)"
_LABEL = re.compile(
    rf"(\w+?(?:\.\d+(?:_rtc|_warm\d+)?)?)(?:_every{_COUNT})?(?:_of([2-9]|[1-9]\d+))?(_ensembled)?(_ahead)?(?::({'|'.join(WEIGHTS)}))?"
    rf"(?:@(?:{_NUMBER}(?:-{_NUMBER})?|([A-Za-z]\w*(?:@.+)?)))?"
)
_NAME = re.compile(rf"(?:uniform{_COUNT}(?:_(?!$)|$))?(?:({CHAIN_PATTERN})(?:_warm{_COUNT}|(_rtc))?)?")


@dataclass(frozen=True)
class MethodSpec:
    """Specification of a method: what it prunes, how it samples, and how its chunks are executed.

    Every function that takes a method takes this or its label; ``str(spec)`` is the label.

    Attributes:
        planner: key of `METHODS` or a saved planner; of a vision-language-action policy, key of `TOKEN_METHODS`.
        interval: of the planner ``"uniform"``: every block is computed each so many steps, and in the last.
        sampler: its name; None for the policy's own, or the one that a saved planner was made for.
        warm: the sampler's last steps that a policy call with a last chunk takes, see `WarmStart`; None begins from noise.
        rtc: calls are guided toward what is left of the last chunk, see `RealtimeChunking`.
        every: environment steps from one call to the next; None leaves them to the benchmark.
        samples: chunks that a call samples, of which the one that agrees best with the last chunk is played.
        ensembled: the chunks are averaged over calls, see `TemporalEnsemble`.
        ahead: in a world that does not wait, the policy is shown the state in which its answer will begin.
        weights: ``"bf16"`` or ``"int8"``, which the native engine rounds to; None rounds nothing.
        rates: prune rates: none, one for every call, or two, of coarse and of fine motion. Of a token method, the number
            that it is tuned by.
        like: label of the token method whose tokens are matched.

    Raises:
        InputError: naming the field, for values that no label says.

    Examples:
        >>> str(MethodSpec(sampler="ddpm5_logsnr", weights="int8"))
        'ddpm5_logsnr:int8'
        >>> MethodSpec.parse("sag_rates@0.95-0.7").rates
        (0.95, 0.7)
        >>> MethodSpec.parse("uniform2_ddim10_every2_of8") == MethodSpec("uniform", 2, "ddim10", every=2, samples=8)
        True
    """

    planner: str = "dense"
    interval: int | None = None
    sampler: str | None = None
    warm: int | None = None
    rtc: bool = False
    every: int | None = None
    samples: int = 1
    ensembled: bool = False
    ahead: bool = False
    weights: str | None = None
    rates: tuple[float, ...] = ()
    like: str | None = None

    def __post_init__(self) -> None:
        for field, read in zip(fields(self), _read(str(self)), strict=True):
            if (value := getattr(self, field.name)) != read:
                raise InputError(f"{field.name}: expected {read!r}, as {str(self)!r} is read, got {value!r}")

    @classmethod
    def parse(cls, method: MethodSpec | str) -> MethodSpec:
        """Parse a label to a method; a `MethodSpec` is returned unchanged.

        Raises:
            InputError: unless the label is written as the module says.
        """
        return method if isinstance(method, MethodSpec) else cls(*_read(method))

    @property
    def name(self) -> str:
        """The label's part for planner, sampler and start."""
        planner = f"{self.planner}{self.interval or ''}"
        alone = self.sampler is not None and planner == "dense"
        start = (f"warm{self.warm}" if self.warm else None, "rtc" if self.rtc else None)
        return "_".join(filter(None, (None if alone else planner, self.sampler, *start)))

    def __str__(self) -> str:
        every = "" if self.every is None else f"_every{self.every}"
        samples = "" if self.samples == 1 else f"_of{self.samples}"
        weights = "" if self.weights is None else f":{self.weights}"
        numbers = self.like or "-".join(np.format_float_positional(rate, trim="-") for rate in self.rates)
        return (
            f"{self.name}{every}{samples}{'_ensembled' * self.ensembled}{'_ahead' * self.ahead}{weights}"
            f"{'@' if numbers else ''}{numbers}"
        )


def _read(label: str) -> tuple[Any, ...]:
    """Return the fields of a label, in order."""
    match = _LABEL.fullmatch(label)
    if match is None:
        raise InputError(
            "methods: expected NAME, NAME@RATE, NAME@COARSE-FINE or NAME@METHOD, NAME also as NAME_everyN, NAME_ofS, "
            f"NAME_ensembled, NAME_ahead, NAME:bf16 or NAME:int8, got {label!r}"
        )
    planner, every, samples, ensembled, ahead, weights, *rates, like = match.groups()
    interval = sampler = warm = rtc = None
    if (named := _NAME.fullmatch(planner)) is not None:
        interval, sampler, warm, rtc = named.groups()
        planner = "uniform" if interval else "dense"
    return (
        planner,
        interval and int(interval),
        sampler,
        warm and int(warm),
        rtc is not None,
        every and int(every),
        int(samples or 1),
        ensembled is not None,
        ahead is not None,
        weights,
        tuple(float(rate) for rate in rates if rate is not None),
        like,
    )
