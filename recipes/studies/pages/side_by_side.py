"""Methods of several tasks side by side, next to a paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.result_files import Row, Table

__all__ = ["Published", "PublishedFigure", "side_by_side"]


@dataclass(frozen=True)
class PublishedFigure:
    """A paper's figures for one method on one task: success in percent, and speed-up over dense."""

    success: float
    speedup: float | None = None

    def __str__(self) -> str:
        """Return the text of a cell.

        >>> str(PublishedFigure(96, 3.33)), str(PublishedFigure(75))
        ('96, 3.33×', '75')
        """
        return f"{self.success:g}" + (f", {self.speedup:.2f}×" if self.speedup else "")


@dataclass(frozen=True)
class Published:
    """All figures taken from one paper.

    Attributes:
        source: where they are from, for people.
        names: our name of a method -> the paper's.
        tasks: task, as ``results.json`` names it -> our name of a method -> its figure.
    """

    source: str
    names: dict[str, str]
    tasks: dict[str, dict[str, PublishedFigure]]


def side_by_side(
    tables: Sequence[Table],
    cells: Sequence[str],
    *,
    methods: Sequence[str] = (),
    published: Published | None = None,
    titles: Mapping[str, str] | None = None,
) -> list[Row]:
    """Return one row per method, with a column per task.

    Args:
        tables: of the tasks. Of several of one task the first that has a method counts.
        cells: columns whose texts, joined by commas, a cell shows; of those that are empty it shows nothing.
        methods: the rows; all without it.
        published: figures to put in a column before each task's own.
        titles: task -> heading of its column, where that is another.

    Raises:
        InputError: if a method is in none of the tables, or a column not in all.
    """
    found: dict[str, dict[str, str]] = {table.task: {} for table in tables}
    for table in tables:
        for row in table.rows:
            if missing := [cell for cell in cells if cell not in row]:
                raise InputError(f"cells: expected some of {' | '.join(row)}, got {' | '.join(missing)}")
            found[table.task].setdefault(
                table.name(row), ", ".join(filter(None, (row[cell] for cell in cells)))
            )
    known = list(dict.fromkeys(name for texts in found.values() for name in texts))
    if unknown := [name for name in methods if name not in known]:
        raise InputError(f"methods: expected some of {' | '.join(known)}, got {' | '.join(unknown)}")
    titles = titles or {}
    return [_row(name, found, published, titles) for name in methods or known]


def _row(
    name: str,
    found: Mapping[str, Mapping[str, str]],
    published: Published | None,
    titles: Mapping[str, str],
) -> Row:
    theirs = published.names.get(name) if published else None
    row = {"method": f"{theirs} / `{name}`" if theirs else name}
    for task, texts in found.items():
        title = titles.get(task, task)
        if published:
            figure = published.tasks.get(task, {}).get(name)
            row[f"{title}, published"] = str(figure) if figure else ""
            title = "here" if len(found) == 1 else f"{title}, here"
        row[title] = texts.get(name, "")
    return row
