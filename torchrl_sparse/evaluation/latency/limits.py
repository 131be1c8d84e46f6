"""Limits of a machine: its rates of reading weights and of multiplying them."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import torch

from torchrl_sparse.blocks.engine.program import build_program
from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.runtime.clock import synchronised_clock

__all__ = ["block_weights", "measure_bandwidth", "measure_multiply_adds", "program_seconds"]

_CPU = torch.device("cpu")


def block_weights(network: TransformerForDiffusion) -> tuple[int, int, int]:
    """Count the weights that one SA, CA and FFN block must read; folded cross-attention reads almost none."""
    width = network.n_emb
    return 4 * width * width, 0, 8 * width * width


def measure_bandwidth(network: TransformerForDiffusion, repeats: int = 20) -> float:
    """Measure the bytes per second at which one thread repeatedly reads as much as one denoising step's weights.

    The best of ``repeats``; of a network on a GPU, that is what reads.
    """
    size = network.n_layer * sum(block_weights(network))
    array = torch.ones(size, device=network.like.device)
    return 4 * size / min(_timed(array.sum, repeats, array.device))


def measure_multiply_adds(size: int = 1536, repeats: int = 5, device: torch.device = _CPU) -> float:
    """Measure the FLOPs (2 * MAC) per second of a large f32 matrix product in PyTorch, best of ``repeats``.

    Of the two libraries that PyTorch may have for it the faster one counts: on AMD's CPUs MKL's vectors are half as wide as
    oneDNN's.
    """
    matrix, out = (torch.ones(size, size, device=device) for _ in range(2))
    products = torch.mm, make_linear(matrix, torch.zeros(size, device=device))
    times = [_timed(lambda product=product: product(matrix, out), repeats, device) for product in products]
    best = min(map(min, times))
    return 2 * size**3 / best


def program_seconds(case: EngineCase, repeats: int = 50) -> float:
    """Measure the median seconds to compile a new random mask to a program."""
    mask = case.queries["random91"].mask[0].cpu().numpy()
    return statistics.median(_timed(lambda: build_program(mask), repeats))


def _timed(call: Callable[[], Any], repeats: int, device: torch.device = _CPU) -> list[float]:
    samples = []
    for _ in range(repeats):
        start = synchronised_clock(device)
        call()
        samples.append(synchronised_clock(device) - start)
    return samples
