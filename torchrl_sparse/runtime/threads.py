"""Temporary change of PyTorch's number of threads."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchrl_sparse.errors import InputError

__all__ = ["num_threads"]


@contextmanager
def num_threads(threads: int | None) -> Iterator[None]:
    """Run a block with ``threads`` intra-op threads of PyTorch (None: unchanged), and restore them afterwards.

    Raises:
        InputError: for fewer than one thread.

    >>> with num_threads(1):
    ...     torch.get_num_threads()
    1
    """
    if threads is not None and threads < 1:
        raise InputError(f"threads: expected at least 1 or None, got {threads}")
    before = torch.get_num_threads()
    if threads is not None:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
