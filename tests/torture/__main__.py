"""The campaign: kills, malformed files, hostile archives, engine fuzzing, shared folders and small disks, one after the other.

    python -m tests.torture seed=7 minutes=30 out=outputs/torture
    python -m tests.torture seed=8 parts=[kills]    # adds its counts to those of the report that is there

writes ``report.json`` into ``out`` as it goes, so that a campaign cut short keeps its counts, and ends with code 1 if a case
was not survived. A campaign of the same machine's model adds to the report that it finds.
`make torture` builds the sanitized engine before.
"""

from __future__ import annotations

import random
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import OmegaConf

from tests.torture.archives import torture_archives
from tests.torture.engine_fuzz import torture_engines
from tests.torture.files import torture_files
from tests.torture.folders import torture_folder
from tests.torture.kills import RESUMED, Killer, torture_recipes
from tests.torture.processes import Hang
from tests.torture.recipes import tiny_recipes
from tests.torture.report import Campaign, Report, Verdict, added, format_report, load_report, save_report

SANITIZED = Path(__file__).parents[2] / "build" / "sanitize" / "native.so"
PARTS = ("archives", "files", "engines", "folders", "kills")
_SHARES = {"archives": 0.1, "files": 0.3, "engines": 0.2}  # of the minutes at most; recipes have what is left
_SAVED_EVERY = 10.0  # seconds


@dataclass
class Options:
    """What the command line says.

    Attributes:
        seed: of everything that is drawn; a new one unless given, printed.
        parts: of the campaign, of archives, files, engines, folders and kills.
        minutes: after which no further case is begun. Each part has a share of them and takes its cases in random order.
        kills: after which there are enough; None goes on until ``minutes`` are over.
        files: share of the malformed files that is tried.
        queries: that engines are fuzzed with.
        out: folder of the report.
    """

    seed: int = field(default_factory=lambda: secrets.randbelow(10**6))
    parts: list[str] = field(default_factory=lambda: list(PARTS))
    minutes: float = 30.0
    kills: int | None = None
    files: float = 1.0
    queries: int = 900
    out: str = "outputs/torture"


class Book:
    """Counts the verdicts of a campaign and keeps their report on disk, on top of an earlier one."""

    def __init__(self, options: Options, command: str) -> None:
        self._path = Path(options.out) / "report.json"
        self._earlier = load_report(self._path) if self._path.exists() else None
        self._began, self._campaign = time.monotonic(), Campaign(options.seed, command)
        self.note = self._campaign.note

    def take(self, verdicts: Iterable[Verdict], until: float = float("inf")) -> None:
        """Count verdicts as they come, none after ``until`` on the monotonic clock."""
        saved = time.monotonic()
        for verdict in verdicts:
            self._campaign.add(verdict)
            if time.monotonic() - saved > _SAVED_EVERY:
                self.save()
                saved = time.monotonic()
            if time.monotonic() > until:
                break
        self.save()

    def save(self) -> Report:
        """Write the report as it is now and return it."""
        report = self._campaign.report((time.monotonic() - self._began) / 60)
        if self._earlier is not None:
            report = added(self._earlier, report)
        save_report(report, self._path)
        return report


def run(options: Options, command: str) -> Report:
    """Run the campaign and return its report.

    Raises:
        ValueError: if a part has another name than those that there are.
    """
    if unknown := set(options.parts) - set(PARTS):
        raise ValueError(f"parts: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    length, book = 60 * options.minutes, Book(options, command)
    deadline = time.monotonic() + length
    parts: dict[str, Callable[[float], Iterable[Verdict]]] = {
        "archives": lambda seconds: torture_archives(options.seed),
        "files": lambda seconds: torture_files(options.seed, options.files),
        "engines": lambda seconds: _engines(options, book, seconds),
    }
    for name, torture in parts.items():
        if name in options.parts:
            seconds = length if options.parts == [name] else length * _SHARES[name]
            # the engines' process keeps the time itself
            book.take(torture(seconds), float("inf") if name == "engines" else time.monotonic() + seconds)
    if {"folders", "kills"} & set(options.parts):
        _disturb(options, book, deadline)
    return book.save()


def _engines(options: Options, book: Book, seconds: float) -> Iterable[Verdict]:
    library = SANITIZED if SANITIZED.exists() else None
    if library is None:
        book.note("Without the sanitizers: `make sanitize` builds their library.")
    return torture_engines(options.seed, options.queries, library, seconds)


def _disturb(options: Options, book: Book, deadline: float) -> None:
    """Run each recipe undisturbed, share and fill its folder, and kill it; then kill all in turn while there is time."""
    with tempfile.TemporaryDirectory() as folder:
        work, rng = Path(folder), random.Random(options.seed)
        recipes, killers = list(tiny_recipes(work)), []
        for number, tiny in enumerate(rng.sample(recipes, len(recipes))):
            if number and time.monotonic() > deadline:
                return
            runs = work / f"runs{number}"  # Hydra's options cannot hold every name
            try:
                killers.append(Killer(tiny, runs, rng))
            except (Hang, RuntimeError) as error:
                book.take([Verdict(RESUMED, tiny.name, "undisturbed", str(error))])
                continue
            if "folders" in options.parts:
                book.take(torture_folder(killers[-1], runs, rng))
            if "kills" in options.parts:
                book.take(killers[-1].chain(deadline=deadline))
        if "kills" in options.parts:
            book.take(torture_recipes(killers, deadline, options.kills))


def main(words: list[str]) -> int:
    """Run the campaign with the options of a command line; return the exit code."""
    options = OmegaConf.to_object(
        OmegaConf.merge(OmegaConf.structured(Options), OmegaConf.from_dotlist(words))
    )
    print(f"seed={options.seed}", flush=True)
    told = [word for word in words if not word.startswith("out=")]
    report = run(options, " ".join(["python -m tests.torture", *told]))
    print(f"\n{format_report(report)}\n\n{Path(options.out) / 'report.json'}")
    return int(any(row.faults for row in report.rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
