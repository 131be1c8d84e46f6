"""Experts of the benchmarks outside robosuite: they see what a policy observes; what they draw or plan is hidden from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from torchrl_sparse.envs.experts.block_push import BlockPushExpert
from torchrl_sparse.envs.experts.pusht import PushTExpert

__all__ = ["BENCHMARK_EXPERTS", "BenchmarkExpert", "make_benchmark_expert"]


class BenchmarkExpert(Protocol):
    """A scripted expert for one episode.

    Attributes:
        noise: standard deviation of what is added to its actions while demonstrating, in their units.
    """

    noise: float

    def command(self, state: np.ndarray) -> np.ndarray:
        """The action, f64 [A], in a state [Ds]."""


BENCHMARK_EXPERTS: Mapping[str, type[BenchmarkExpert]] = {"BlockPush": BlockPushExpert, "PushT": PushTExpert}
"""The expert of each benchmark that has one, made from a random generator; Franka Kitchen has none."""


def make_benchmark_expert(task: str, rng: np.random.Generator) -> BenchmarkExpert:
    """The expert of a benchmark for one episode.

    Raises:
        ValueError: if there is none; the message lists those there are.
    """
    if task not in BENCHMARK_EXPERTS:
        raise ValueError(f"task: expected one with an expert ({', '.join(BENCHMARK_EXPERTS)}), got {task!r}")
    return BENCHMARK_EXPERTS[task](rng)
