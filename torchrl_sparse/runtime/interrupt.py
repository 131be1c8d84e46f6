"""Stopping long work cleanly."""

from __future__ import annotations

import signal

__all__ = ["StopSignal"]


class StopSignal:
    """Remembers SIGINT or SIGTERM so that the step in progress is finished and saved; a second one kills.

    Attributes:
        name: name of the signal that came; None while there was none.

    Examples:
        >>> stop = StopSignal()
        >>> stop.name is None
        True
    """

    def __init__(self) -> None:
        self.name: str | None = None
        self._previous = {
            number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)
        }

    def _note(self, number: int, _frame: object) -> None:
        self.name = signal.Signals(number).name
        for each, handler in self._previous.items():
            signal.signal(each, handler)
