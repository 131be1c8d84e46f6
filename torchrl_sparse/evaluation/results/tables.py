"""Formatting of text rows as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tabulate import tabulate

from torchrl_sparse.errors import InputError

__all__ = ["LEFT", "markdown_table", "select_columns"]

LEFT = frozenset(
    {
        *("task", "like", "method", "family", "against", "verdict", "time verdict", "budget"),
        *("latency", "variant", "design", "part of a dense policy call", "at 20 times dense's speed"),
    }
)
"""Columns of words, which are aligned to the left; those of numbers are aligned to the right."""


def markdown_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a Markdown table that also lines up in a terminal.

    Args:
        rows: column -> text, at least one; the first says which columns there are.

    >>> print(markdown_table([{"method": "dense", "p50": "128"}, {"method": "bac", "p50": "23"}]))
    | method   |   p50 |
    |:---------|------:|
    | dense    |   128 |
    | bac      |    23 |
    """
    columns = list(rows[0])
    aligned = ["left" if column in LEFT else "right" for column in columns]
    cells = [[row[column] for column in columns] for row in rows]
    return tabulate(cells, columns, tablefmt="pipe", colalign=aligned, disable_numparse=True)


def select_columns(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows with only these columns, in this order.

    Raises:
        InputError: if a row lacks one of them.

    >>> select_columns([{"method": "dense", "p50": "128"}], ["p50"])
    [{'p50': '128'}]
    """
    for row in rows:
        if missing := [column for column in columns if column not in row]:
            raise InputError(f"columns: expected some of {' | '.join(row)}, got {' | '.join(missing)}")
    return [{column: row[column] for column in columns} for row in rows]
