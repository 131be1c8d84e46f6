"""Workspaces of the PyTorch engine, kept for later policy calls."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import torch

from torchrl_sparse.blocks.engine.torch.graphs import GraphCapture
from torchrl_sparse.blocks.engine.torch.loop import Segment, Workspace
from torchrl_sparse.blocks.engine.torch.tables import Tables

__all__ = ["Capture", "WorkspacePool"]

Capture = Callable[[Segment], Segment]


class WorkspacePool:
    """Pool of idle workspaces; a policy call that finds none gets a new one.

    Args:
        tables: of the network.
        capacity: how many may wait; the least recently used goes first.

    Attributes:
        new_capture: makes what turns the segments of one workspace into CUDA graphs; None leaves them as they are.
    """

    def __init__(self, tables: Tables, capacity: int = 8) -> None:
        self._tables, self._capacity = tables, capacity
        self._free: list[tuple[tuple, Workspace]] = []
        self._lock = threading.Lock()
        self.new_capture: Callable[[], Capture] | None = None
        if tables.device.type == "cuda":
            self.new_capture = partial(GraphCapture, tables.device)

    @property
    def captures(self) -> bool:
        """True if segments are captured as CUDA graphs, so that batches have to be padded."""
        return self.new_capture is not None

    @contextmanager
    def take(self, batch: int, slots: int, guided: bool = False) -> Iterator[Workspace]:
        """Lend the caller exclusively a workspace for ``batch`` rows and ``slots`` latest outputs, guided or not."""
        # On a GPU the next policy call may be launched before the last one has run, but in the same order only in one stream.
        stream = (
            torch.cuda.current_stream(self._tables.device) if self._tables.device.type == "cuda" else None
        )
        key = (batch, slots, guided, stream)
        with self._lock:
            index = next((i for i, (known, _) in enumerate(self._free) if known == key), None)
            workspace = None if index is None else self._free.pop(index)[1]
        if workspace is None:
            # Each has a capture of its own: workspaces are used at the same time, and one that fails is not tried again.
            capture = self.new_capture() if self.new_capture is not None else None
            workspace = Workspace(self._tables, batch, slots, capture, guided=guided)
        yield workspace
        with self._lock:
            self._free.append((key, workspace))
            del self._free[: -self._capacity]
