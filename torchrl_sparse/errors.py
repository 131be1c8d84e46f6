"""The error of every refused input: an option, a file, a tensor or a policy. Imports nothing."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Error for a refused input, in one line: ``ENTRY: expected what would do, got what came``.

    Attributes:
        entry: key, option, argument or file to be changed, with the entry of a file behind it: ``config.json: sampler``.

    >>> InputError("episodes: expected at least 1, got 0").entry
    'episodes'
    """

    @property
    def entry(self) -> str:
        text = str(self)
        entry, form, _ = text.partition(": expected ")
        return entry if form else text.partition(": ")[0]
