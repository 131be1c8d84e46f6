"""The campaign: kills, malformed files, hostile archives, engine fuzzing, shared folders and small disks, one after the other.

    python -m tests.torture seed=7 minutes=30 out=outputs/torture

writes ``report.json`` and the table of the page, ``page.md``, into ``out`` and ends with code 1 if a case was not survived.
`make torture` builds the sanitized engine before.
"""

from __future__ import annotations

import random
import secrets
import sys
import tempfile
import time
from collections.abc import Iterable
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
from tests.torture.report import Campaign, Report, Verdict, format_report, save_report

SANITIZED = Path(__file__).parents[2] / "build" / "sanitize" / "native.so"


@dataclass
class Options:
    """What the command line says.

    Attributes:
        seed: of everything that is drawn; a new one unless given, printed.
        minutes: after which no further recipe is killed; the other parts come first and are not cut short.
        kills: after which there are enough; None goes on until ``minutes`` are over.
        files: share of the malformed files that is tried.
        queries: that engines are fuzzed with.
        out: folder of the report.
    """

    seed: int = field(default_factory=lambda: secrets.randbelow(10**6))
    minutes: float = 30.0
    kills: int | None = None
    files: float = 1.0
    queries: int = 900
    out: str = "outputs/torture"


def run(options: Options, command: str) -> Report:
    """Run the campaign and return its report."""
    began, campaign = time.monotonic(), Campaign(options.seed, command)
    library = SANITIZED if SANITIZED.exists() else None
    if library is None:
        campaign.note("Without the sanitizers: `make sanitize` builds their library.")
    _take(campaign, torture_archives())
    _take(campaign, torture_files(options.seed, options.files))
    _take(campaign, torture_engines(options.seed, options.queries, library, 60 + options.queries))
    deadline = began + 60 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        rng, killers = random.Random(options.seed), []
        for tiny in list(tiny_recipes(work)):
            runs = work / tiny.name
            try:
                killers.append(Killer(tiny, runs, rng))
            except (Hang, RuntimeError) as error:
                campaign.add(Verdict(RESUMED, tiny.name, "undisturbed", str(error)))
            else:
                _take(campaign, torture_folder(killers[-1], runs, rng))
        _take(campaign, torture_recipes(killers, deadline, options.kills))
    return campaign.report((time.monotonic() - began) / 60)


def _take(campaign: Campaign, verdicts: Iterable[Verdict]) -> None:
    for verdict in verdicts:
        campaign.add(verdict)


def main(words: list[str]) -> int:
    """Run the campaign with the options of a command line; return the exit code."""
    options = OmegaConf.to_object(
        OmegaConf.merge(OmegaConf.structured(Options), OmegaConf.from_dotlist(words))
    )
    print(f"seed={options.seed}", flush=True)
    report = run(options, " ".join(["python -m tests.torture", *words]))
    out = Path(options.out)
    save_report(report, out / "report.json")
    (out / "page.md").write_text(format_report(report) + "\n", encoding="utf-8")
    print(f"\n{format_report(report)}\n\n{out / 'report.json'}")
    return int(any(row.faults for row in report.rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
