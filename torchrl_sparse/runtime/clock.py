"""A clock that synchronises with the device."""

import time

import torch

__all__ = ["synchronised_clock"]


def synchronised_clock(device: torch.device) -> float:
    """Return seconds of a monotonic clock, after all work queued on ``device`` is done.

    >>> start = synchronised_clock(torch.device("cpu"))
    >>> synchronised_clock(torch.device("cpu")) >= start
    True
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
