"""Colours of methods, the same in every figure: Okabe and Ito's, which colour-blind readers can tell apart."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from torchrl_sparse.methods.diffusion import METHODS
from torchrl_sparse.methods.vla import TOKEN_METHODS

__all__ = ["OTHER_COLORS", "method_colors"]

# Of methods whose table names none.
OTHER_COLORS = (
    *("#009E73", "#8C6BB1", "#A6761D", "#B2182B", "#4D4D4D", "#66A61E"),
    *("#E7298A", "#1B7F79", "#BCBD22", "#3F2A8C", "#F46D43", "#74A9CF"),
    *("#7A4B2A", "#9E9AC8", "#FB9A99", "#00441B"),
)


def method_colors(methods: Iterable[str]) -> dict[str, str]:
    """Assign every method a colour: its fixed one from the table, or else an unused one.

    A method is looked up without what follows ``@``; of several that differ in that alone, the first has the table's colour.

    >>> method_colors(["mine", "bac", "fastv@0.3", "fastv@0.5"])
    {'mine': '#009E73', 'bac': '#0072B2', 'fastv@0.3': '#4D4D4D', 'fastv@0.5': '#8C6BB1'}
    """
    methods, known = (
        list(methods),
        {name: method.color for name, method in {**TOKEN_METHODS, **METHODS}.items()},
    )
    named: dict[str, str] = {}
    for name in methods:
        color = known.get(name.partition("@")[0])
        if color is not None and color not in named.values():
            named[name] = color
    left = itertools.cycle(color for color in OTHER_COLORS if color not in named.values())
    return {name: named.get(name) or next(left) for name in methods}
