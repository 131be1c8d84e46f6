"""Percentiles of the latest latencies."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

__all__ = ["Latencies"]


class Latencies:
    """Keeps the latest latencies, and tells their percentiles, computed at most twice a second.

    Args:
        kept: how many are kept.

    >>> latencies = Latencies()
    >>> for seconds in (0.001, 0.002, 0.003):
    ...     latencies.add(seconds)
    >>> latencies.percentiles_ms()
    {'p50_ms': 2.0, 'p99_ms': 2.98}
    """

    def __init__(self, kept: int = 4096):
        self._kept: deque[float] = deque(maxlen=kept)
        self._told: dict[str, float] = {}
        self._due = 0.0

    def add(self, seconds: float) -> None:
        """Take one more latency, in seconds."""
        self._kept.append(seconds)

    def percentiles_ms(self) -> dict[str, float]:
        """Return ``p50_ms`` and ``p99_ms``, in milliseconds; nothing before the first latency."""
        if self._kept and (now := time.monotonic()) >= self._due:
            middle, tail = np.percentile(self._kept, (50, 99)) * 1000
            self._told = {"p50_ms": round(float(middle), 3), "p99_ms": round(float(tail), 3)}
            self._due = now + 0.5
        return self._told
