"""Comparable latency measurements: one process, interleaved, warmed up, synchronised, with threads stated.

Timing one method to the end before the next compares two states of the machine (clock, caches, neighbours) as much as two
methods. Here every round calls each candidate once, in an order shuffled per round, so that a slow minute hits all of them.
"""

import os
import platform
import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.threads import num_threads

__all__ = [
    "Latency",
    "Machine",
    "describe_machine",
    "measure_latency",
    "next_arguments",
    "summarize_latency",
    "usable_cores",
]


@dataclass(frozen=True)
class Latency:
    """Latency of one policy call.

    Attributes:
        p50: median, seconds.
        p95: 95th percentile, seconds.
        n: timed calls.
        samples: every timed call in the order of execution, seconds.
    """

    p50: float
    p95: float
    n: int
    samples: tuple[float, ...] = ()


@dataclass(frozen=True)
class Machine:
    """The machine that latencies were measured on: processor, PyTorch's threads, device, PyTorch's version, date and time."""

    cpu: str
    threads: int
    device: str
    torch: str
    date: str


def summarize_latency(samples: Sequence[float]) -> Latency:
    """Summarise latencies, in seconds, by percentiles (linear interpolation).

    Raises:
        InputError: if there are none, or one is negative or not finite.

    >>> latency = summarize_latency([0.1, 0.2, 0.3])
    >>> latency.p50, latency.n
    (0.2, 3)
    """
    values = np.asarray(samples, dtype=np.float64)
    if values.size == 0:
        raise InputError("latencies: expected at least one, got none")
    if not np.isfinite(values).all() or (values < 0).any():
        raise InputError(
            f"latencies: expected finite seconds of at least 0, got min {values.min()} s and max {values.max()} s"
        )
    p50, p95 = np.percentile(values, [50, 95])
    return Latency(float(p50), float(p95), int(values.size), tuple(values.tolist()))


def measure_latency(
    callables: Mapping[str, Callable[..., Any]],
    repeats: int = 20,
    warmup: int = 3,
    threads: int | None = None,
    *,
    inputs: Mapping[str, Iterator[Any]] | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    on_round: Callable[[int, int], None] | None = None,
) -> dict[str, Latency]:
    """Time several callables, interleaved and without gradients.

    Args:
        callables: name -> function; one call is one policy call.
        repeats: timed rounds; every round calls each candidate once.
        warmup: untimed rounds before them.
        threads: intra-op threads of PyTorch while measuring (restored afterwards); None leaves the setting
            alone.
        inputs: name -> what its function is called with, the next at each call, made before the clock starts; a function
            that is not in it takes nothing.
        device: synchronised before the clock starts and before it stops.
        seed: of the order within the rounds.
        on_round: called as ``on_round(done, repeats)`` after each timed round.

    Returns:
        name -> :class:`Latency`, in the order of ``callables``.

    Raises:
        InputError: if there is nothing to time or a count is out of range.

    >>> result = measure_latency({"fast": lambda: None, "slow": lambda: sum(range(20000))}, repeats=5)
    >>> result["fast"].p50 < result["slow"].p50, result["slow"].n
    (True, 5)
    """
    if not callables:
        raise InputError("calls: expected at least one to time, got none")
    if repeats < 1 or warmup < 0:
        raise InputError(f"repeats, warmup: expected at least 1 and 0, got {repeats} and {warmup}")
    device, inputs = torch.device(device), inputs or {}
    order = list(callables)
    generator = random.Random(seed)
    samples: dict[str, list[float]] = {name: [] for name in callables}
    with num_threads(threads), torch.no_grad():
        for round_index in range(-warmup, repeats):
            generator.shuffle(order)
            for name in order:
                seconds = _time_once(callables[name], next_arguments(inputs, name), device)
                if round_index >= 0:
                    samples[name].append(seconds)
            if on_round is not None and round_index >= 0:
                on_round(round_index + 1, repeats)
    return {name: summarize_latency(values) for name, values in samples.items()}


def next_arguments(inputs: Mapping[str, Iterator[Any]], name: str) -> tuple[Any, ...]:
    """Return the arguments for the next call of ``name``: one input if it has inputs, else none.

    >>> next_arguments({"add": iter([5])}, "add"), next_arguments({}, "add")
    ((5,), ())
    """
    return (next(inputs[name]),) if name in inputs else ()


def describe_machine(device: torch.device | str = "cpu", threads: int | None = None) -> Machine:
    """Describe the machine of the measurements.

    Args:
        device: where the policy runs.
        threads: the threads used; None takes PyTorch's present setting.

    >>> describe_machine(threads=2).threads
    2
    """
    device = torch.device(device)
    name = f"{device.type} ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type
    cores = usable_cores()
    return Machine(
        cpu=f"{_cpu_model()}, {cores} {'core' if cores == 1 else 'cores'} usable",
        threads=torch.get_num_threads() if threads is None else int(threads),
        device=name,
        torch=torch.__version__,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )


def _time_once(call: Callable[..., Any], arguments: Sequence[Any], device: torch.device) -> float:
    _synchronize(device)
    start = time.perf_counter()
    call(*arguments)
    _synchronize(device)
    return time.perf_counter() - start


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif device.type == "mps":
        torch.mps.synchronize()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    # A container often sees all the host's cores but may run on a few of them only.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()
