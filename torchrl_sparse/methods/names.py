"""How methods are written."""

from __future__ import annotations

import re
from dataclasses import dataclass

__all__ = ["MethodName"]


@dataclass(frozen=True)
class MethodName:
    """A method as it is written: ``NAME``, ``NAME@RATE`` or ``NAME@COARSE-FINE``, NAME also as ``NAME:WEIGHTS``.

    Attributes:
        name: see `torchrl_sparse.methods.diffusion`.
        rates: prune rates: none, one for every query, or two, of coarse and of fine motion.
        weights: ``"bf16"``, ``"int8"``, or None, which rounds nothing.
    """

    name: str
    rates: tuple[float, ...] = ()
    weights: str | None = None

    @classmethod
    def parse(cls, text: str) -> MethodName:
        """Raise ValueError unless ``text`` is written as above.

        >>> MethodName.parse("sag_rates@0.95-0.7")
        MethodName(name='sag_rates', rates=(0.95, 0.7), weights=None)
        >>> MethodName.parse("dense:int8").weights
        'int8'
        """
        match = re.fullmatch(r"(\w+(?:\.\d+)?)(?::(bf16|int8))?(?:@(0?\.\d+)(?:-(0?\.\d+))?)?", text)
        if match is None:
            raise ValueError(
                f"methods: expected NAME, NAME@RATE or NAME@COARSE-FINE, NAME also as NAME:bf16 or NAME:int8, got {text!r}"
            )
        name, weights, *rates = match.groups()
        return cls(name, tuple(float(rate) for rate in rates if rate is not None), weights)
