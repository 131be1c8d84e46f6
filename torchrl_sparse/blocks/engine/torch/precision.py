"""The precision in which the PyTorch engines compute: that of the weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["weights_precision"]


@contextmanager
def weights_precision(device: torch.device) -> Iterator[None]:
    """Compute without gradients and in the type of the weights, which autocast would change."""
    with torch.inference_mode(), torch.autocast(device.type, enabled=False):
        yield
