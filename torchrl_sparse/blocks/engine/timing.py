"""Timing of single blocks, for planners that budget in time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch

__all__ = ["time_blocks"]


def time_blocks(
    walk: Callable[[int], None], types: Sequence[str], num_layers: int, repeats: int, device: torch.device
) -> dict[str, float]:
    """Measure the seconds of a block of each type: the minimum of ``repeats``, which other processes disturb least.

    Args:
        walk: runs the blocks of one type (an index of ``types``) of all layers, so that weights come from
            where they come from in a policy call.
        types: blocks of a layer.
        num_layers: layers L.
        repeats: timed walks of each type, interleaved, after a few that are not timed.
        device: synchronised around every walk if it is a GPU.
    """
    samples: list[list[float]] = [[] for _ in types]
    for turn in range(-3, repeats):
        for kind in range(len(types)):
            seconds = _time_once(walk, kind, device) / num_layers
            if turn >= 0:
                samples[kind].append(seconds)
    return {name: min(samples[kind]) for kind, name in enumerate(types)}


def _time_once(walk: Callable[[int], None], kind: int, device: torch.device) -> float:
    _synchronize(device)
    start = time.perf_counter()
    walk(kind)
    _synchronize(device)
    return time.perf_counter() - start


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
