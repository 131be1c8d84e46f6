"""Suggestions for misspelt names."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = ["closest", "did_you_mean"]


def closest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name most similar to ``name``; None if none is close."""
    close = get_close_matches(name, [*known], n=1)
    return close[0] if close else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean ...?"`` for the end of an error message; empty if no known name is close.

    >>> did_you_mean("benchmrak", ["benchmark", "report"]), did_you_mean("magic", ["benchmark", "report"])
    (', did you mean benchmark?', '')
    """
    close = closest(name, known)
    return "" if close is None else f", did you mean {close}?"
