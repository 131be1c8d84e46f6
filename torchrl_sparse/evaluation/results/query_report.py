"""``query.json``: the parts of a policy call, its thread scaling, and its tail latency."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.latency.profile import serial_share
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import threads_text
from torchrl_sparse.storage.json import read_json

__all__ = ["QueryProfile", "format_query_profile", "load_query_profile", "query_rows"]


@dataclass(frozen=True)
class QueryProfile:
    """The content of a ``query.json``. Seconds.

    Attributes:
        machine: that was measured on.
        sampler: name of the sampler.
        parts_s: ``"query"`` and the parts that it is made of, medians; see `call_parts`.
        threads_s: name of a sampler -> number of threads, as text -> median of an unpruned policy call.
        tails_s: ``"Python"``, and ``"C"`` if the exported policy was asked too -> ``"p50"``, ``"p99"``, ``"p99.9"`` and
            ``"max"`` of ``queries``.
        queries: of each that were timed for the tail, in turns.
        hz: how often each began; None is one after the other.
        busy: other processes that computed meanwhile.
    """

    format: Literal["query/2"]
    machine: Machine
    sampler: str
    parts_s: dict[str, float]
    threads_s: dict[str, dict[str, float]]
    tails_s: dict[str, dict[str, float]]
    queries: int
    busy: int
    hz: float | None = None


def format_query_profile(found: QueryProfile) -> str:
    """Return three tables in Markdown, each below a line that describes it."""
    tables = query_rows(found)
    parts = found.parts_s
    whole = (
        f"{parts['query'] / parts['blocks']:.2f} times its blocks"
        if "blocks" in parts
        else f"{1e3 * parts['query']:.2f} ms"
    )
    return "\n\n".join(
        [
            f"A policy call, {found.sampler}: {whole}.",
            markdown_table(tables["parts"]),
            "Policy calls by number of threads, milliseconds.",
            markdown_table(tables["threads"]),
            f"{found.queries} policy calls, {_pace_text(found)}.",
            markdown_table(tables["tails"]),
        ]
    )


def query_rows(found: QueryProfile) -> dict[str, list[dict[str, str]]]:
    """Return the rows of ``"parts"``, ``"threads"`` and ``"tails"``, column -> text."""
    whole = found.parts_s["query"]
    parts = [
        {"part": name, "p50, ms": f"{1e3 * seconds:.3f}", "share": f"{seconds / whole:.0%}"}
        for name, seconds in found.parts_s.items()
    ]
    tails = [
        {
            "called from": name,
            "beside": f"{found.busy} busy processes",
            "queries": f"{found.queries}, {_pace_text(found)}",
            **{f"{at}, ms": f"{1e3 * seconds:.3f}" for at, seconds in tail.items()},
        }
        for name, tail in found.tails_s.items()
    ]
    threads = [_thread_row(name, seconds) for name, seconds in found.threads_s.items()]
    return {"parts": parts, "threads": threads, "tails": tails}


def _pace_text(found: QueryProfile) -> str:
    return "one after the other" if found.hz is None else f"{found.hz:g} times a second"


def load_query_profile(path: str | Path) -> QueryProfile:
    """Read a ``query.json``.

    Raises:
        FileNotFoundError: if it is not there.
        InputError: if it is of another version or not as `QueryProfile` says.
    """
    return read_json(path, QueryProfile)


def _thread_row(name: str, seconds: dict[str, float]) -> dict[str, str]:
    times = {threads_text(int(count)): f"{1e3 * value:.3f}" for count, value in seconds.items()}
    share = serial_share({int(count): value for count, value in seconds.items()})
    return {"query": name, **times, "serial share": f"{share:.0%}"}
