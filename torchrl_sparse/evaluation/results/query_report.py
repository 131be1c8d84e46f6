"""``query.json``: what a query's time goes to, what more threads make of it, and how late the latest of many come."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.latency.profile import serial_share
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import threads_text

__all__ = ["QueryProfile", "format_query_profile"]


@dataclass(frozen=True)
class QueryProfile:
    """The content of a ``query.json``. Seconds.

    Attributes:
        machine: that was measured on.
        sampler: name of the sampler.
        parts_s: ``"query"`` and the parts that it is made of, medians; see `query_parts`.
        threads_s: name of a sampler -> number of threads, as text -> median of an unpruned query.
        tail_s: ``"p50"``, ``"p99"``, ``"p99.9"`` and ``"max"`` of ``queries``.
        queries: that were timed for the tail.
        hz: how often they began; None is one after the other.
        exported_tail_s: the same of the exported policy's queries in C, if it was asked for.
        busy: other processes that computed meanwhile.
    """

    format: Literal["query/1"]
    machine: Machine
    sampler: str
    parts_s: dict[str, float]
    threads_s: dict[str, dict[str, float]]
    tail_s: dict[str, float]
    queries: int
    busy: int
    hz: float | None = None
    exported_tail_s: dict[str, float] | None = None


def format_query_profile(found: QueryProfile) -> str:
    """Return three tables in Markdown, each below the line that says what it is."""
    whole = found.parts_s["query"]
    parts = [
        {"part": name, "p50, ms": f"{1e3 * seconds:.3f}", "share": f"{seconds / whole:.0%}"}
        for name, seconds in found.parts_s.items()
    ]
    threads = [_thread_row(name, seconds) for name, seconds in found.threads_s.items()]
    pace = "one after the other" if found.hz is None else f"{found.hz:g} times a second"
    tails = {"Python": found.tail_s, "C": found.exported_tail_s or {}}
    late = [
        {"called from": name, **{f"{at}, ms": f"{1e3 * seconds:.3f}" for at, seconds in tail.items()}}
        for name, tail in tails.items()
        if tail
    ]
    return "\n\n".join(
        [
            f"A query, {found.sampler}: {whole / found.parts_s['blocks']:.2f} times its blocks.",
            markdown_table(parts),
            "Queries by number of threads, milliseconds.",
            markdown_table(threads),
            f"{found.queries} queries, {pace}, beside {found.busy} busy processes.",
            markdown_table(late),
        ]
    )


def _thread_row(name: str, seconds: dict[str, float]) -> dict[str, str]:
    times = {threads_text(int(count)): f"{1e3 * value:.3f}" for count, value in seconds.items()}
    share = serial_share({int(count): value for count, value in seconds.items()})
    return {"query": name, **times, "serial share": f"{share:.0%}"}
