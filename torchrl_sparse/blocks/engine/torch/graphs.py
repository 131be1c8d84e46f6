"""CUDA graphs of the PyTorch engine's operations."""

from __future__ import annotations

import threading
from collections.abc import Callable

import torch

__all__ = ["GraphCapture", "padded_batch"]

_WARM_UP = 3
# A thread that begins to capture waits for the device, which would end the capture of another.
_CAPTURES = threading.Lock()


class GraphCapture:
    """Capturer of argument-free functions as CUDA graphs.

    They may launch what they like but read and write only memory that outlives the graph, and may not wait for the device.
    All graphs of one `GraphCapture` take their scratch memory from one pool: none leaves anything there for another, so
    they may be played in any order, one at a time. Graphs that may be played at the same time, and those after a capture
    that failed, need a `GraphCapture` of their own.

    Args:
        device: a CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, segment: Callable[[], object]) -> Callable[[], object]:
        """Return ``segment`` as a graph, to be called like it; the segment runs a few times."""
        with _CAPTURES:
            present = torch.cuda.current_stream(self._device)
            self._stream.wait_stream(present)
            # Libraries initialise themselves in their first calls, which a capture does not allow.
            with torch.cuda.stream(self._stream):
                for _ in range(_WARM_UP):
                    segment()
            present.wait_stream(self._stream)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"):
                segment()
        return graph.replay


def padded_batch(rows: int) -> int:
    """Round a batch size up to a power of two: the number of due rows varies, and each size needs its own graph.

    >>> [padded_batch(rows) for rows in (1, 2, 3, 5, 8, 9)]
    [1, 2, 4, 8, 8, 16]
    """
    return 1 << (rows - 1).bit_length()
