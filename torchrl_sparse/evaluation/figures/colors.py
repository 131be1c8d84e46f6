"""Colours that mean the same in every figure: Okabe and Ito's, which stay apart for colour-blind readers."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from torchrl_sparse.methods.diffusion import METHODS

__all__ = ["OTHER_COLORS", "REUSED_COLOR", "TYPE_COLORS", "method_colors"]

TYPE_COLORS = ("#0072B2", "#009E73", "#D55E00")
"""Of computed blocks, in the order of `BLOCK_TYPES`."""

REUSED_COLOR = "#E9E9EC"

# Of methods whose table names none.
OTHER_COLORS = (
    *("#009E73", "#8C6BB1", "#A6761D", "#B2182B", "#4D4D4D", "#66A61E"),
    *("#E7298A", "#1B7F79", "#BCBD22", "#3F2A8C", "#F46D43", "#74A9CF"),
    *("#7A4B2A", "#9E9AC8", "#FB9A99", "#00441B"),
)


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """Give every method a colour: that of `METHODS`, the same one in every figure, or one that is left.

    >>> method_colors(["mine", "bac"])
    {'mine': '#009E73', 'bac': '#0072B2'}
    """
    others = itertools.cycle(OTHER_COLORS)
    known = {name: method.color for name, method in METHODS.items()}
    return {name: known.get(name) or next(others) for name in methods}
