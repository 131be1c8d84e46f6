"""Rows of text as a table."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

__all__ = ["markdown_table"]


def markdown_table(rows: Sequence[Mapping[str, str]], left: Collection[str]) -> str:
    """Markdown that also lines up in a terminal.

    Args:
        rows: column -> text, at least one; the first says which columns there are.
        left: columns that are aligned to the left, all others to the right.

    >>> print(markdown_table([{"method": "dense", "p50": "128"}, {"method": "bac", "p50": "23"}], left=["method"]))
    | method | p50 |
    |:-------|----:|
    | dense  | 128 |
    | bac    |  23 |
    """
    columns = list(rows[0])
    widths = {column: max(len(column), *(len(row[column]) for row in rows)) for column in columns}

    def line(row: Mapping[str, str]) -> str:
        cells = (
            row[column].ljust(widths[column]) if column in left else row[column].rjust(widths[column])
            for column in columns
        )
        return f"| {' | '.join(cells)} |"

    rules = (f":{'-' * (widths[c] + 1)}" if c in left else f"{'-' * (widths[c] + 1)}:" for c in columns)
    head = [line({column: column for column in columns}), f"|{'|'.join(rules)}|"]
    return "\n".join([*head, *map(line, rows)])
