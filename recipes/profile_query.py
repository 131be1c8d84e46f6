"""Profile one query in the native engine: its parts, its threads, and its tail.

    python recipes/profile_query.py policy=assets/lift sampler=ddim_87_20
    python recipes/profile_query.py queries=100000 hz=50 busy=1 library=build/tsp/libtsp.so     # 33 minutes

Writes OUT/query.json, three tables and OUT/query_threads.png. Times are medians, everything interleaved in one process; in
the tail, which comes last, every query counts: Ctrl-C ends it with those that there are.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.figures.latency import plot_thread_scaling
from torchrl_sparse.evaluation.latency.measure import describe_machine, usable_cores
from torchrl_sparse.evaluation.latency.profile import (
    busy_cores,
    exported_call,
    paced_seconds,
    policy_inputs,
    query_parts,
    tail,
    thread_seconds,
)
from torchrl_sparse.evaluation.results.query_report import QueryProfile, format_query_profile
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads
from torchrl_sparse.storage.json import write_json


@recipe("profile_query")
def main(config: DictConfig) -> None:
    policy = DiffusionPolicy.from_pretrained(config.policy, engine=config.engine)
    dense, chosen = policy.sampler, policy.sampler.variant_named(config.sampler)
    policy.sampler = chosen
    # Threads that wait for each other on one core show the scheduler, not the engine.
    counts = sorted({1, *(count for count in config.thread_counts if count <= usable_cores())})
    with num_threads(config.threads):
        parts = query_parts(policy, config.repeats, config.warmup)
    threads = thread_seconds(
        policy.network, {"dense": dense, config.sampler: chosen}, counts, config.repeats, config.warmup
    )
    with num_threads(config.threads):
        samples = query_samples(policy, config)
    found = QueryProfile(
        format="query/2",
        machine=describe_machine(threads=config.threads),
        sampler=config.sampler,
        parts_s=parts,
        threads_s={name: {str(count): at[count] for count in at} for name, at in threads.items()},
        tails_s={name: tail(seconds) for name, seconds in samples.items()},
        queries=len(samples["Python"]),
        busy=config.busy,
        hz=config.hz,
    )
    out = Path(config.out)
    write_json(out / "query.json", found)
    plot_thread_scaling(found.threads_s, found.machine, out / "query_threads.png")
    print(f"\n{format_query_profile(found)}\n\nfiles are in {out}")


def query_samples(policy: DiffusionPolicy, config: DictConfig) -> dict[str, list[float]]:
    """Time many queries from Python and, with a library, as many in C between them."""
    with ExitStack() as stack:
        calls: dict[str, Callable[..., Any]] = {"Python": policy}
        if config.library:
            calls["C"] = stack.enter_context(exported_call(policy, Path(config.library)))
        stack.enter_context(busy_cores(config.busy))
        show = stack.enter_context(progress("tail", "query", config.queries))
        inputs = {"Python": policy_inputs(policy)}
        return paced_seconds(calls, config.queries, config.hz, show, inputs=inputs)


if __name__ == "__main__":
    main()
