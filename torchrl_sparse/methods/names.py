"""How methods are written."""

from __future__ import annotations

import re
from dataclasses import dataclass

from torchrl_sparse.errors import InputError

__all__ = ["WEIGHTS", "MethodName"]

WEIGHTS = ("bf16", "int8")

_PATTERN = re.compile(
    # The policy, and how its chunks are executed.
    r"(\w+?(?:\.\d+)?)(?:_every([1-9]\d*))?(?:_of([2-9]|[1-9]\d+))?(_ensembled)?(_ahead)?"
    rf"(?::({'|'.join(WEIGHTS)}))?(?:@(0?\.\d+)(?:-(0?\.\d+))?)?"
)


@dataclass(frozen=True)
class MethodName:
    """A method as it is written: ``NAME``, ``NAME_everyN``, ``NAME_ofS`` or ``NAME_everyN_ofS``, behind that perhaps
    ``_ensembled`` and ``_ahead``, then ``:WEIGHTS``, and then ``@RATE`` or ``@COARSE-FINE``.

    Attributes:
        name: see `torchrl_sparse.methods.diffusion`.
        rates: prune rates: none, one for every query, or two, of coarse and of fine motion.
        weights: ``"bf16"``, ``"int8"``, or None, which rounds nothing.
        every: environment steps from one query to the next; None leaves them to the benchmark.
        samples: chunks that a query samples, of which the one that agrees best with the last chunk is played.
        ensembled: the chunks are averaged over queries, see `TemporalEnsemble`.
        ahead: in a world that does not wait, the policy is shown the state in which its answer will begin.
    """

    name: str
    rates: tuple[float, ...] = ()
    weights: str | None = None
    every: int | None = None
    samples: int = 1
    ensembled: bool = False
    ahead: bool = False

    @classmethod
    def parse(cls, text: str) -> MethodName:
        """Raise ValueError unless ``text`` is written as above.

        >>> MethodName.parse("sag_rates@0.95-0.7").rates
        (0.95, 0.7)
        >>> MethodName.parse("dense:int8").weights
        'int8'
        >>> MethodName.parse("ddpm3_logsnr_every2_of8")
        MethodName(name='ddpm3_logsnr', rates=(), weights=None, every=2, samples=8, ensembled=False, ahead=False)
        """
        match = _PATTERN.fullmatch(text)
        if match is None:
            raise InputError(
                "methods: expected NAME, NAME@RATE or NAME@COARSE-FINE, NAME also as NAME_everyN, NAME_ofS, NAME_ensembled, "
                f"NAME_ahead, NAME:bf16 or NAME:int8, got {text!r}"
            )
        name, every, samples, ensembled, ahead, weights, *rates = match.groups()
        return cls(
            name,
            tuple(float(rate) for rate in rates if rate is not None),
            weights,
            None if every is None else int(every),
            int(samples or 1),
            ensembled is not None,
            ahead is not None,
        )
