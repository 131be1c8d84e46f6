"""What a campaign tried and what came of it: verdicts, their sums as JSON, and the table of the page.

python -m tests.torture.report    # writes the table of tests/torture/README.md again from report.json beside it
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tabulate import tabulate

from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import read_json, write_json

FOLDER = Path(__file__).parent
PAGE, REPORT = FOLDER / "README.md", FOLDER / "report.json"
_TABLE = re.compile(r"(<!-- report -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Verdict:
    """One case that was tried.

    Attributes:
        part: of the campaign.
        subject: of the part: a recipe, a kind of file, an engine.
        case: names it within the subject; with the campaign's seed it can be made again.
        fault: what should not have happened; None where the case was survived.
        tags: by which cases of a subject are counted, such as the signal of a kill.
    """

    part: str
    subject: str
    case: str
    fault: str | None = None
    tags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fault:
    """A case that was not survived, and what happened."""

    case: str
    fault: str


@dataclass(frozen=True)
class Row:
    """The sum of a subject's cases."""

    part: str
    subject: str
    cases: int
    tags: dict[str, int]
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class Report:
    """A campaign: where, when and how it ran, and one row per subject, in the order in which they came.

    Campaigns add up: ``minutes`` and ``rows`` are their sums, ``seeds`` and ``commands`` those of each, the rest is the last's.
    ``load`` is how many processes wanted a core just before it began: those of others.
    """

    format: Literal["torchrl_sparse.torture/1"]
    cpu: str
    load: float
    date: str
    minutes: float
    seeds: tuple[int, ...]
    commands: tuple[str, ...]
    notes: tuple[str, ...]
    rows: tuple[Row, ...]


class Campaign:
    """Takes verdicts down; begin it before the first case, for its date and the load of others.

    >>> campaign = Campaign(seed=3, command="make torture")
    >>> campaign.add(Verdict("kill", "sweep", "SIGINT after 1.0 s", tags=("SIGINT",)))
    >>> campaign.report(minutes=0.5).rows[0].tags
    {'SIGINT': 1}
    """

    def __init__(self, seed: int, command: str) -> None:
        self._machine, self._load = describe_machine(), os.getloadavg()[0]
        self._seed, self._command = seed, command
        self._notes: list[str] = []
        self._verdicts: dict[tuple[str, str], list[Verdict]] = {}

    def add(self, verdict: Verdict) -> None:
        """Count a verdict; print it if it is a fault."""
        self._verdicts.setdefault((verdict.part, verdict.subject), []).append(verdict)
        if verdict.fault is not None:
            print(f"FAULT {verdict.part}, {verdict.subject}, {verdict.case}: {verdict.fault}", flush=True)

    def note(self, text: str) -> None:
        """Keep what readers of the table should know, such as a part that this machine cannot run."""
        print(text, flush=True)
        self._notes.append(text)

    def report(self, minutes: float) -> Report:
        """Sum up."""
        return Report(
            format="torchrl_sparse.torture/1",
            cpu=self._machine.cpu,
            load=round(self._load, 1),
            date=self._machine.date,
            minutes=round(minutes, 1),
            seeds=(self._seed,),
            commands=(self._command,),
            notes=tuple(self._notes),
            rows=tuple(_row(verdicts) for verdicts in self._verdicts.values()),
        )


def _row(verdicts: list[Verdict]) -> Row:
    return Row(
        verdicts[0].part,
        verdicts[0].subject,
        len(verdicts),
        dict(sorted(Counter(tag for verdict in verdicts for tag in verdict.tags).items())),
        tuple(Fault(verdict.case, verdict.fault) for verdict in verdicts if verdict.fault is not None),
    )


def added(earlier: Report, later: Report) -> Report:
    """Return the sum of two reports.

    Raises:
        ValueError: if they were written on processors of different models.
    """
    if earlier.cpu != later.cpu:
        raise ValueError(f"cpu: expected {earlier.cpu} as in the report that is there, got {later.cpu}")
    rows = {(row.part, row.subject): row for row in earlier.rows}
    for row in later.rows:
        before = rows.get((row.part, row.subject))
        rows[row.part, row.subject] = row if before is None else _sum(before, row)
    return replace(
        later,
        minutes=round(earlier.minutes + later.minutes, 1),
        seeds=earlier.seeds + later.seeds,
        commands=earlier.commands + later.commands,
        notes=tuple(dict.fromkeys(earlier.notes + later.notes)),
        rows=tuple(rows.values()),
    )


def _sum(one: Row, other: Row) -> Row:
    tags = dict(sorted((Counter(one.tags) + Counter(other.tags)).items()))
    return replace(one, cases=one.cases + other.cases, tags=tags, faults=one.faults + other.faults)


def format_report(report: Report) -> str:
    """Return the report as Markdown: a line on the campaign, the table, and every case that was not survived."""
    total, faults = (
        sum(row.cases for row in report.rows),
        [fault for row in report.rows for fault in row.faults],
    )
    head = (
        f"{report.date[:10]}, {report.cpu}, shared with other work (load {report.load:g} before it began), "
        f"{report.minutes:g} minutes, seeds {', '.join(map(str, report.seeds))}: "
        f"{', '.join(f'`{command}`' for command in dict.fromkeys(report.commands))}. "
        f"{total} cases, {total - len(faults)} survived."
    )
    return "\n\n".join([head, *report.notes, _table(report.rows), *_faults(report.rows)])


def _table(rows: Iterable[Row]) -> str:
    cells = [[row.part, row.subject, row.cases, _tags(row.tags), row.cases - len(row.faults)] for row in rows]
    columns = ["what is done", "to what", "cases", "of these", "survived"]
    aligned = ["left", "left", "right", "left", "right"]
    return tabulate(cells, columns, tablefmt="pipe", colalign=aligned, disable_numparse=True)


def _tags(tags: dict[str, int]) -> str:
    return ", ".join(f"{count} {tag}" for tag, count in tags.items())


def _faults(rows: Iterable[Row]) -> list[str]:
    lines = [f"- {row.part}, {row.subject}, {f.case}: {f.fault}" for row in rows for f in row.faults]
    return ["Not survived:", "\n".join(lines)] if lines else []


def write_page(report: Report, page: Path = PAGE) -> None:
    """Put a report between the two comments of the page."""
    text = render_page(page.read_text(encoding="utf-8"), report)
    with atomic_path(page) as temporary:
        temporary.write_text(text, encoding="utf-8")


def render_page(text: str, report: Report) -> str:
    """Return the text of a page with a report in its place.

    Raises:
        ValueError: if the page has no place for one.
    """
    text, places = _TABLE.subn(lambda place: f"{place[1]}\n{format_report(report)}\n\n{place[2]}", text)
    if places != 1:
        raise ValueError(f"page: expected one <!-- report --> and its <!-- end -->, got {places}")
    return text


def load_report(path: Path = REPORT) -> Report:
    """Read a report."""
    return read_json(path, Report)


def save_report(report: Report, path: Path) -> None:
    """Write a report."""
    write_json(path, report)


if __name__ == "__main__":
    write_page(load_report())
