"""The error of a run that ends without a bug: a recipe says it in one line, any other `RuntimeError` keeps its traceback."""

from __future__ import annotations

__all__ = ["RunFailed"]


class RunFailed(RuntimeError):
    """A run cannot go on, by no fault of this library's: no GL, an expert that fails, workers that die again and again.

    >>> isinstance(RunFailed("the expert fails"), RuntimeError)
    True
    """
