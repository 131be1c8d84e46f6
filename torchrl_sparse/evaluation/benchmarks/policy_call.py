"""Measurements of one diffusion policy call: its parts, thread scaling, and tail latency; see `results.query_report`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_sparse.evaluation.latency.measure import describe_machine, usable_cores
from torchrl_sparse.evaluation.latency.profile import (
    busy_cores,
    call_parts,
    exported_call,
    paced_seconds,
    policy_inputs,
    tail,
    thread_seconds,
)
from torchrl_sparse.evaluation.results.query_report import QueryProfile
from torchrl_sparse.networks.diffusion.naming import SamplerName
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["measure_call"]


def measure_call(
    policy: DiffusionPolicy,
    *,
    threads: int | None,
    thread_counts: Sequence[int],
    repeats: int,
    warmup: int,
    queries: int,
    hz: float | None = None,
    busy: int = 0,
    library: str | Path | None = None,
) -> QueryProfile:
    """Time the parts of a policy call, unpruned calls by number of threads, and many calls from Python and in C.

    Args:
        policy: on the CPU, with the sampler and the plan of the call.
        threads: of PyTorch and the engine, for the parts and the tail; None leaves PyTorch's.
        thread_counts: that unpruned calls are timed on, dense ones too, as far as there are so many cores.
        repeats, warmup: rounds of parts and threads, see `measure_latency`.
        queries: of the tail.
        hz: how often they begin; None: one after the other.
        busy: processes that compute meanwhile.
        library: ``libtsp.so``, to ask the exported policy in C too.

    Raises:
        InputError: if the native engine cannot run the policy here, or ``library`` not the exported policy.
    """
    samplers = {"dense": policy.sampler.variant()}
    if policy.sampler.config != samplers["dense"].config:
        samplers[_label(policy.sampler)] = policy.sampler
    *_, name = samplers
    # Threads that wait for each other on one core show the scheduler, not the engine.
    counts = sorted({1, *(count for count in thread_counts if count <= usable_cores())})
    engine = "native" if policy.engine == "auto" else policy.engine
    with num_threads(threads):
        parts = call_parts(policy, repeats, warmup)
    by_threads = thread_seconds(policy.network, samplers, counts, repeats, warmup, engine=engine)
    with num_threads(threads):
        samples = _tails(policy, queries, hz, busy, library)
        machine = describe_machine()
    return QueryProfile(
        format="query/2",
        machine=machine,
        sampler=name,
        parts_s=parts,
        threads_s={name: {str(count): at[count] for count in at} for name, at in by_threads.items()},
        tails_s={caller: tail(seconds) for caller, seconds in samples.items()},
        queries=len(samples["Python"]),
        busy=busy,
        hz=hz,
    )


def _label(sampler: Sampler) -> str:
    """Return the name under which `Sampler.from_name` finds the sampler, its number of steps included."""
    parts = SamplerName.parse(sampler.name)
    return str(parts if parts.timesteps else replace(parts, num_inference_steps=sampler.num_inference_steps))


def _tails(
    policy: DiffusionPolicy, queries: int, hz: float | None, busy: int, library: str | Path | None
) -> dict[str, list[float]]:
    """Time many calls from Python and, with a library, as many in C between them."""
    with ExitStack() as stack:
        calls: dict[str, Callable[..., Any]] = {"Python": policy}
        if library is not None:
            calls["C"] = stack.enter_context(exported_call(policy, Path(library)))
        stack.enter_context(busy_cores(busy))
        show = stack.enter_context(progress("tail", "query", queries))
        return paced_seconds(calls, queries, hz, show, inputs={"Python": policy_inputs(policy)})
