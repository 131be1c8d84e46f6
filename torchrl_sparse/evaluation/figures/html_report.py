"""Self-contained HTML page of any set of results files.

Tables and figures are made from the files alone; pictures and videos that lie beside them are embedded as data URIs. A
content security policy forbids the page every request, and the template escapes everything that was read from a file.
"""

from __future__ import annotations

import base64
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torchrl_sparse.evaluation.figures.acceleration import plot_acceleration
from torchrl_sparse.evaluation.figures.curves import plot_success_within
from torchrl_sparse.evaluation.figures.pareto import plot_pareto
from torchrl_sparse.evaluation.figures.realtime import plot_realtime
from torchrl_sparse.evaluation.results.acceleration import (
    acceleration_note,
    acceleration_rows,
    load_acceleration,
)
from torchrl_sparse.evaluation.results.realtime import load_realtime, realtime_note, realtime_rows
from torchrl_sparse.evaluation.results.report import results_note, results_rows
from torchrl_sparse.evaluation.results.result_files import READERS, Row, read_tables
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.evaluation.results.tables import LEFT, select_columns
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["Medium", "Run", "find_runs", "write_page", "write_report"]

_DRAWN = {  # by the beginning of a file's name, what is drawn of it too: results.json, results_400.json
    "acceleration": (
        load_acceleration,
        acceleration_rows,
        acceleration_note,
        {"error to demonstrations against latency": plot_acceleration},
    ),
    "results": (
        load_results,
        results_rows,
        results_note,
        {"success against latency": plot_pareto, "success within the time allowed": plot_success_within},
    ),
    "realtime": (load_realtime, realtime_rows, realtime_note, {"success against latency": plot_realtime}),
}
_KINDS = (*_DRAWN, *READERS)
_MEDIA = {".png": "image/png", ".mp4": "video/mp4"}
# From the numbers, instead of a file that may be older than they are.
_DRAWN_HERE = ("acceleration.png", "pareto.png", "realtime.png", "success_within.png")
_TEMPLATE = "report.html.jinja"


@dataclass(frozen=True)
class Medium:
    """A picture or a video, as a data URI."""

    source: str
    caption: str
    is_video: bool

    @classmethod
    def read(cls, path: Path, caption: str) -> Medium:
        """Read a file as a data URI."""
        data = base64.b64encode(path.read_bytes()).decode("ascii")
        return cls(f"data:{_MEDIA[path.suffix]};base64,{data}", caption, path.suffix == ".mp4")


@dataclass(frozen=True)
class Run:
    """One results file: its tables by name, notes and figures, or the error in it."""

    name: str
    tables: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    note: str = ""
    figures: Sequence[Medium] = ()
    fault: str = ""

    @classmethod
    def read(cls, file: Path, name: str) -> Run:
        """Read a results file and draw its figures."""
        try:
            return cls._drawn(file, name) if _is_drawn(file) else cls(name, _tables(file))
        except (ValueError, OSError) as error:
            return cls(name, fault=str(error))

    @classmethod
    def _drawn(cls, file: Path, name: str) -> Run:
        load, make_rows, make_note, plots = _DRAWN[_beginning(file)]
        results = load(file)
        with tempfile.TemporaryDirectory() as folder:
            figures = [
                Medium.read(plot(results, Path(folder) / "figure.png"), caption)
                for caption, plot in plots.items()
            ]
        return cls(name, {"": make_rows(results)}, make_note(results), figures)


def _tables(file: Path) -> dict[str, list[dict[str, str]]]:
    """Return every table of a file that nothing is drawn of, with the columns that it shows."""
    return {name: select_columns(found.rows, found.columns) for name, found in read_tables(file).items()}


def _beginning(file: Path) -> str:
    return file.stem.partition("_")[0]


def _is_drawn(file: Path) -> bool:
    return _beginning(file) in _DRAWN


def find_runs(root: str | os.PathLike) -> list[Path]:
    """Return the results files below a folder, sorted.

    Raises:
        FileNotFoundError: if there is none.
    """
    found = sorted(path for path in Path(root).rglob("*.json") if path.name.startswith(_KINDS))
    if not found:
        expected = " or ".join(f"{kind}.json" for kind in _KINDS)
        raise FileNotFoundError(f"{root}: expected {expected} in it or below it, got none")
    return found


def write_report(
    root: str | os.PathLike, path: str | os.PathLike, *, title: str = "torchrl_sparse"
) -> dict[str, str]:
    """Write the page of all results below ``root``.

    Args:
        root: folder of runs; see `find_runs`.
        path: of the HTML file.
        title: of the page.

    Returns:
        file -> what is wrong with it, for the files that could not be read. The page names them too.

    Raises:
        FileNotFoundError: if there is no run.

    Examples:
        >>> import tempfile
        >>> page = Path(tempfile.mkdtemp()) / "report.html"
        >>> write_report("assets/lift", page)
        {}
        >>> 'src="http' in page.read_text()
        False
    """
    root, files = Path(root), find_runs(root)
    runs = [Run.read(file, str(file.relative_to(root))) for file in files]
    folders = {file.parent for file in files}
    media = {str(folder.relative_to(root.parent)): _media(folder, folders) for folder in sorted(folders)}
    write_page(runs, path, title=title, folders={name: found for name, found in media.items() if found})
    return {run.name: run.fault for run in runs if run.fault}


def write_page(
    runs: Sequence[Run],
    path: str | os.PathLike,
    *,
    title: str,
    folders: Mapping[str, Sequence[Medium]] | None = None,
) -> Path:
    """Write a page that needs nothing else; return its path.

    Args:
        runs: its sections.
        path: of the HTML file.
        title: of the page.
        folders: name -> pictures and videos that are shown below all sections.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined
    )
    page = environment.get_template(_TEMPLATE).render(
        title=title, runs=runs, folders=folders or {}, left=LEFT
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page + "\n", encoding="utf-8")
    return Path(path)


def _media(folder: Path, folders: set[Path]) -> list[Medium]:
    """Embed the pictures and videos of one run: in its folder and below, but not in other runs'."""
    return [
        Medium.read(path, path.stem.replace("_", " "))
        for path in sorted(folder.rglob("*"))
        if path.suffix in _MEDIA
        and path.name not in _DRAWN_HERE
        and not path.name.startswith(".")
        and next(parent for parent in path.parents if parent in folders) == folder
    ]
