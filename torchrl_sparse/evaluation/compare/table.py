"""Episodes as a table of text: a line each, with a head."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.compare.outcomes import Outcome, Start, as_boolean, as_count

__all__ = ["read_table"]

_MOST_BYTES = 64 << 20


def read_table(path: Path) -> dict[str, list[Outcome]]:
    """Return the episodes of every method in a CSV: empty is the name of the only one of a table without that column.

    Columns are ``success`` and ``seed`` or ``index``; ``steps``, ``score``, ``error``, ``task`` and ``method`` if they are
    there. Others are left alone.

    Raises:
        InputError: naming file, line and column.
    """
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path}: expected at most {_MOST_BYTES} bytes of CSV, got {path.stat().st_size}")
    found: dict[str, list[Outcome]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            head = [name.strip().lower() for name in next(reader, [])]
            kind = _check_head(path, head)
            for cells in reader:
                if not cells:
                    continue
                where = f"{path}:{reader.line_num}"
                if len(cells) != len(head):
                    raise InputError(
                        f"{where}: expected {len(head)} cells, as its head has, got {len(cells)}"
                    )
                row = {name: cell.strip() for name, cell in zip(head, cells, strict=True)}
                found.setdefault(row.get("method", ""), []).append(_outcome(where, kind, row))
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a CSV in UTF-8, got: {error}") from error
    if not found:
        raise InputError(f"{path}: expected a line for each episode below its head, got none")
    return found


def _check_head(path: Path, head: list[str]) -> str:
    kinds = [kind for kind in ("seed", "index") if kind in head]
    if len(kinds) != 1 or "success" not in head or len(set(head)) < len(head):
        raise InputError(
            f"{path}:1: expected the columns success and either seed or index, each once, got {', '.join(head)[:200]!r}"
        )
    return kinds[0]


def _outcome(where: str, kind: str, row: Mapping[str, str]) -> Outcome:
    start = Start(row.get("task", ""), kind, as_count(row[kind], f"{where}: {kind}"))  # type: ignore[arg-type]
    steps, score, error = row.get("steps"), row.get("score"), row.get("error", "")
    solved = False if error else as_boolean(row["success"], f"{where}: success")
    return Outcome(
        start,
        solved,
        as_count(steps, f"{where}: steps") if steps else None,
        _number(score, f"{where}: score") if score else None,
        error,
    )


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{where}: expected a number, got {text!r}") from None
