"""Any set of ``results.json`` and ``realtime.json`` as one HTML page that needs nothing else.

Tables and figures are made from the files alone; pictures and videos that lie beside them are embedded as data URIs. A
content security policy forbids the page every request, and everything that was read from a file is escaped.
"""

from __future__ import annotations

import base64
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from torchrl_sparse.evaluation.figures.plots import plot_pareto
from torchrl_sparse.evaluation.results.realtime import (
    load_realtime,
    plot_realtime,
    realtime_note,
    realtime_rows,
)
from torchrl_sparse.evaluation.results.report import load_results, results_note, results_rows
from torchrl_sparse.storage.atomic import atomic_path

__all__ = ["find_runs", "write_report"]

RESULT_FILES = ("results.json", "realtime.json")
_MEDIA = {".png": "image/png", ".mp4": "video/mp4"}
_DRAWN_HERE = (
    "pareto.png",
    "realtime.png",
)  # from the numbers, instead of a file that may be older than they are
_LEFT = ("method", "verdict", "latency")
_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; }
body { max-width: 1100px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; }
h2 { font-size: 1.25rem; margin-top: 3rem; border-top: 1px solid #ddd; padding-top: 1.5rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #e4e4e7; white-space: nowrap; text-align: right; }
th.left, td.left { text-align: left; } th { background: #f6f6f7; }
.note, figcaption { color: #555; font-size: .88rem; } .fault { color: #a11; }
.media { display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: 1rem; }
figure { margin: 0; } img, video { max-width: 100%; height: auto; border: 1px solid #eee; }
"""


def find_runs(root: str | os.PathLike) -> list[Path]:
    """The ``results.json`` and ``realtime.json`` below a folder, sorted.

    Raises:
        FileNotFoundError: if there is none.
    """
    found = sorted(path for path in Path(root).rglob("*.json") if path.name in RESULT_FILES)
    if not found:
        raise FileNotFoundError(f"{root}: expected {' or '.join(RESULT_FILES)} in it or below it, got none")
    return found


def write_report(
    root: str | os.PathLike, path: str | os.PathLike, *, title: str = "torchrl_sparse"
) -> dict[str, str]:
    """Write the page on all runs below ``root``.

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
    sections, faults = [], {}
    folders = {file.parent for file in files}
    for file in files:
        name = str(file.relative_to(root))
        try:
            body = _section(file)
        except ValueError as error:
            faults[name] = str(error)
            body = f'<p class="fault">{escape(str(error))}</p>'
        sections.append(f"<section><h2>{escape(name)}</h2>{body}</section>")
    media = [_media(folder, root, folders) for folder in sorted(folders)]
    page = _page(title, [*sections, *media])
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return faults


def _page(title: str, parts: Iterable[str]) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width"><link rel="icon" href="data:,">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>"
        f"<body><h1>{escape(title)}</h1>{''.join(parts)}</body></html>\n"
    )


def _section(file: Path) -> str:
    """Table, notes and figure of one file of results."""
    if file.name == "realtime.json":
        results = load_realtime(file)
        rows, note, plot = realtime_rows(results), realtime_note(results), plot_realtime
    else:
        results = load_results(file)
        rows, note, plot = results_rows(results), results_note(results), plot_pareto
    return f'{_table(rows)}<p class="note">{escape(note)}</p>{_figure(plot, results)}'


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    def line(tag: str, row: Mapping[str, str]) -> str:
        cells = (
            f"<{tag}{' class=left' if column in _LEFT else ''}>{escape(row[column])}</{tag}>"
            for column in rows[0]
        )
        return f"<tr>{''.join(cells)}</tr>"

    head = line("th", {column: column for column in rows[0]})
    return f"<table><thead>{head}</thead><tbody>{''.join(line('td', row) for row in rows)}</tbody></table>"


def _figure(plot: Any, results: Mapping[str, Any]) -> str:
    with tempfile.TemporaryDirectory() as folder:
        return _embed(plot(results, Path(folder) / "figure.png"), "success against latency")


def _media(folder: Path, root: Path, folders: set[Path]) -> str:
    """The pictures and videos of one run: in its folder and below, but not in other runs'."""
    found = [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix in _MEDIA
        and path.name not in _DRAWN_HERE
        and not path.name.startswith(".")
        and next(parent for parent in path.parents if parent in folders) == folder
    ]
    if not found:
        return ""
    name = escape(str(folder.relative_to(root.parent)))
    figures = "".join(_embed(path, path.stem.replace("_", " ")) for path in found)
    return f'<section><h2>{name}: masks, figures, videos</h2><div class="media">{figures}</div></section>'


def _embed(path: Path, caption: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    source, text = f"data:{_MEDIA[path.suffix]};base64,{data}", escape(caption)
    tag = f'<img alt="{text}" src="{source}">'
    if path.suffix == ".mp4":
        tag = f'<video controls preload="metadata" src="{source}"></video>'
    return f"<figure>{tag}<figcaption>{text}</figcaption></figure>"
