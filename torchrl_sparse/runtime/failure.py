"""Error of a run that ends without a bug: recipes print it in one line; other errors keep their traceback."""

from __future__ import annotations

__all__ = ["RunFailed"]


class RunFailed(RuntimeError):
    """Error for a run that cannot continue through no fault of the library: no GL, a failing expert, workers that keep dying.

    >>> isinstance(RunFailed("the expert fails"), RuntimeError)
    True
    """
