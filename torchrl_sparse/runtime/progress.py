"""Progress bars for work that reports its progress."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

__all__ = ["progress"]


@contextmanager
def progress(description: str, unit: str, total: int | None = None) -> Iterator[Callable[[int, int], None]]:
    """Show a bar and yield the function ``(done, total)`` that updates it.

    >>> with progress("timing", "round") as show:
    ...     show(1, 2)
    """
    with tqdm(total=total, unit=unit, desc=f"{description:>14}") as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show
