"""What somebody who misspelt a name may have meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = ["did_you_mean"]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``", did you mean ...?"`` for the end of an error, or nothing if no known name is close.

    >>> did_you_mean("benchmrak", ["benchmark", "report"]), did_you_mean("magic", ["benchmark", "report"])
    (', did you mean benchmark?', '')
    """
    close = get_close_matches(name, [*known], n=1)
    return f", did you mean {close[0]}?" if close else ""
