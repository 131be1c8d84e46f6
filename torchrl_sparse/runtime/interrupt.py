"""Clean stops of long work on a signal."""

from __future__ import annotations

import signal
from types import TracebackType

__all__ = ["StopSignal"]


class StopSignal:
    """Context that records SIGINT and SIGTERM, so that the work in progress can be finished and saved.

    After the first signal, and at the end of the block, the handlers from before the block are back: a second signal ends
    the program as usual.

    Attributes:
        name: of the signal that came, e.g. ``"SIGTERM"``; None while there was none.

    Raises:
        InputError: by Python when entered elsewhere than in the main thread.

    Examples:
        >>> with StopSignal() as stop:
        ...     stop.name is None
        True
    """

    def __init__(self) -> None:
        self.name: str | None = None

    def __enter__(self) -> StopSignal:
        self._previous = {
            number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._restore()

    def _note(self, number: int, frame: object) -> None:
        self.name = signal.Signals(number).name
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
