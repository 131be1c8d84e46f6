"""CUDA graphs: a whole query as one launch."""

from __future__ import annotations

import threading
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["GraphedQuery"]

_WARM_UP = 3


class GraphedQuery:
    """Calls ``query(noise, cond)`` by replaying a CUDA graph, one per shape of the noise.

    A graph has fixed inputs, so calls are serialised by a lock.

    Args:
        query: launches only; its launches may depend on nothing but the shapes of its arguments.
    """

    def __init__(self, query: Callable[[Tensor, Tensor], Tensor]) -> None:
        self._query = query
        self._graphs: dict[torch.Size, tuple[torch.cuda.CUDAGraph, Tensor, Tensor, Tensor]] = {}
        self._lock = threading.Lock()

    def __call__(self, noise: Tensor, cond: Tensor) -> Tensor:
        """The result of ``query``, in memory of its own."""
        with self._lock:
            if noise.shape not in self._graphs:
                self._graphs[noise.shape] = self._capture(noise.clone(), cond.clone())
            graph, static_noise, static_cond, result = self._graphs[noise.shape]
            static_noise.copy_(noise)
            static_cond.copy_(cond)
            graph.replay()
            return result.clone()

    def _capture(self, noise: Tensor, cond: Tensor) -> tuple[torch.cuda.CUDAGraph, Tensor, Tensor, Tensor]:
        # Libraries initialise themselves in their first calls, which a capture does not allow.
        stream = torch.cuda.Stream(noise.device)
        stream.wait_stream(torch.cuda.current_stream(noise.device))
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._query(noise, cond)
        torch.cuda.current_stream(noise.device).wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            result = self._query(noise, cond)
        return graph, noise, cond, result
