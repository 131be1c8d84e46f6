"""Latency of recorded policy calls, and of their planners."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import cycle

import torch
from tensordict import TensorDictBase

from torchrl_sparse.control.queries import answer, in_turn
from torchrl_sparse.evaluation.latency.measure import Latency, measure_latency, summarize_latency
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.clock import synchronised_clock
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["time_planning", "time_queries"]


def time_queries(
    methods: Mapping[str, DiffusionPolicy],
    queries: TensorDictBase,
    *,
    repeats: int,
    threads: int,
    samples: Mapping[str, int] | None = None,
    on_round: Callable[[int, int], None] | None = None,
) -> dict[str, Latency]:
    """Time recorded policy calls [N] under each method, interleaved, on the methods' device; see `measure_latency`.

    Every round asks all methods the next query: asked the same again, an engine would know the mask already. Methods that
    carry something from call to call have what they left themselves in the one before. Those in ``samples`` are asked it so
    many times at once.
    """
    samples = samples or {}
    inputs = {
        name: in_turn(method, cycle(_copied(queries, samples.get(name, 1)).unbind(0)))
        for name, method in methods.items()
    }
    device = next(iter(methods.values())).device
    return measure_latency(
        methods, repeats=repeats, threads=threads, inputs=inputs, device=device, on_round=on_round
    )


def time_planning(
    methods: Mapping[str, DiffusionPolicy], queries: TensorDictBase, *, threads: int
) -> dict[str, Latency]:
    """Time only the planners in recorded policy calls [N], from encoding to denoising, interleaved.

    In a loop of its own a planner is faster: nothing then drives its weights out of the caches, as the denoiser's do.
    """
    seconds = {name: [] for name in methods}
    with num_threads(threads), torch.no_grad():
        for policy in methods.values():
            answer(policy, queries[0])  # the first takes longer
        for query in queries.unbind(0):
            for name, policy in methods.items():
                seconds[name].append(_planning_seconds(policy, query))
    return {name: summarize_latency(samples) for name, samples in seconds.items()}


def _copied(queries: TensorDictBase, samples: int) -> TensorDictBase:
    """Return policy calls [N, samples], or [N] as they are for one."""
    return queries if samples == 1 else queries[:, None].expand(len(queries), samples).contiguous()


def _planning_seconds(policy: DiffusionPolicy, query: TensorDictBase) -> float:
    encoded = policy.module["encode"](query.select(*policy.in_keys, strict=False))
    encoded = policy.module["start"](encoded)
    start = synchronised_clock(policy.device)
    planned = policy.module["plan"](encoded)
    seconds = synchronised_clock(policy.device) - start
    policy.module["denoise"](planned)
    return seconds
