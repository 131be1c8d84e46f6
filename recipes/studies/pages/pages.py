"""Result tables in Markdown pages: each names the JSON file that it shows, and one command rewrites all of them.

Two comments of a line each enclose every such table; what lies between them is replaced, and
`tests/test_pages.py` fails where a page and its JSON differ::

    <!-- table: assets/can/results.json methods="dense | ddim10 | sag" columns="method | success | verdict | p50, ms" -->
    <!-- end -->

Files are named from the root of the repository. Lists are separated by ``|`` and quoted. Options:

- ``methods``: which rows, in this order; all without it. Rows of ``engine.json`` are its variants.
- ``columns``: which columns, in this order. Those of ``results*.json`` are named as the benchmark prints them, and there are
  also ``success, %``, ``success or score`` (of a graded task), ``action chunks per second`` and ``actions per
  second``, ``mean time, steps``, ``early, %`` (solved within the task's early cut) and ``speed-up, 95 %``. An
  ``engine.json`` also has ``f32 arithmetic alone, ms``, and what reads its weights, ``memory alone, ms``.
- ``rows``: which table of a file with several: ``played`` of an ``acceleration.json``, a shape of an ``engine.json``,
  ``methods``, ``parts`` or ``products`` of a ``vla_latency.json``, ``success`` or ``time`` of an ``offline_agreement.json``, or
  ``headline`` or ``budgets`` of a ``results*.json`` with times, see `choices`, or its ``ways``, ``completed`` (parts of
  the task) or ``scores``, from the ``episodes/`` beside it.
- ``pairs="sag : bac | sag : ddim10"``: differences between methods of a ``results*.json``, from the ``episodes/`` beside it;
  ``pairs="sag +1 : dense_noise +3"``: of a ``realtime*.json``, the first one step late and the second three.
- Several files make one table that begins with a column ``task``; ``tasks="Lift | Can"`` gives other names, one per task.
- ``policies="seed 0 | seed 1"`` tells several policies of one task apart: a name for each file, instead of the task's.
  Files of one policy have the same name.
- ``cells="success, % | speed-up"``: side by side, one row per method and one column per task, which holds these columns of the
  method. Of files of the same task the first that has the method counts. ``published=assets/published.json`` puts a paper's
  figures before each (`Published`).

A line that does not begin with the comment, as an indented one, is left alone.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from recipes.studies.pages.page_rows import read_table
from recipes.studies.pages.side_by_side import Published, side_by_side
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.results.result_files import Row, Table
from torchrl_sparse.evaluation.results.tables import markdown_table, select_columns
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import read_json

__all__ = ["find_pages", "write_pages", "write_tables"]

_FOLDERS = ("assets", "recipes", "tests", "torchrl_sparse", "docs")
_BEGIN, _END = re.compile(r"<!-- table: (.*) -->"), "<!-- end -->"
_OPTIONS = ("methods", "columns", "rows", "pairs", "tasks", "policies", "cells", "published")


@dataclass(frozen=True)
class _Directive:
    """Files and options that one comment names."""

    files: Sequence[str]
    options: Mapping[str, str]

    @classmethod
    def parse(cls, text: str) -> _Directive:
        files, options = [], {}
        for word in shlex.split(text):
            name, equals, value = word.partition("=")
            if equals and name not in _OPTIONS:
                raise InputError(f"expected the options {', '.join(_OPTIONS)}, got {name!r}")
            if equals:
                options[name] = value
            else:
                files.append(word)
        if not files:
            raise InputError(f"expected a file of results, got {text!r}")
        return cls(files, options)

    def parts(self, option: str) -> list[str]:
        """Return the parts of a list, none where it is not given."""
        return [part.strip() for part in self.options.get(option, "").split("|") if part.strip()]


def find_pages(root: str | os.PathLike) -> list[Path]:
    """Return the Markdown pages at a repository's root and in its page folders, sorted."""
    root = Path(root)
    return sorted([*root.glob("*.md"), *(page for name in _FOLDERS for page in (root / name).rglob("*.md"))])


def write_pages(root: str | os.PathLike, *, dry: bool = False) -> list[Path]:
    """Rewrite the tables of all pages.

    Args:
        root: of the repository.
        dry: only tell which pages would change.

    Returns:
        The pages that differed from the JSON.

    Raises:
        FileNotFoundError: if a page names a file that is not there.
        InputError: naming page and line, if a comment cannot be followed.
    """
    changed = []
    for page in find_pages(root):
        before = page.read_text(encoding="utf-8")
        after = write_tables(before, root, str(page))
        if after == before:
            continue
        changed.append(page)
        if not dry:
            with atomic_path(page) as temporary:
                temporary.write_text(after, encoding="utf-8")
    return changed


def write_tables(text: str, root: str | os.PathLike, name: str = "page") -> str:
    """Return a page with its tables rewritten.

    Args:
        text: of the page.
        root: of the repository, which files are named from.
        name: of the page, for errors.

    Raises:
        FileNotFoundError, InputError: as `write_pages`.
    """
    lines, out, number = text.split("\n"), [], 0
    while number < len(lines):
        out.append(lines[number])
        number += 1
        if begin := _BEGIN.fullmatch(out[-1]):
            where = f"{name}:{number}"
            number = _find_end(lines, number, where)
            out += ["", _make_table(begin[1], Path(root), where), ""]
    return "\n".join(out)


def _find_end(lines: Sequence[str], start: int, where: str) -> int:
    for number in range(start, len(lines)):
        if lines[number] == _END:
            return number
        if _BEGIN.fullmatch(lines[number]):
            break
    raise InputError(f"{where}: expected a line {_END} after the table, got none")


def _make_table(text: str, root: Path, where: str) -> str:
    try:
        directive = _Directive.parse(text)
        tables = _read(directive, root)
        rows = _rows(directive, tables, root)
        return "\n\n".join(filter(None, (markdown_table(rows), _family(tables, rows))))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{where}: {error}") from error
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error


def _read(directive: _Directive, root: Path) -> list[Table]:
    pairs = [_pair(pair) for pair in directive.parts("pairs")]
    tables = [read_table(root / file, directive.options.get("rows"), pairs) for file in directive.files]
    policies = directive.parts("policies")
    return _told_apart(tables, policies) if policies else tables


def _rows(directive: _Directive, tables: Sequence[Table], root: Path) -> list[Row]:
    options = directive.options
    tasks = list(dict.fromkeys(table.task for table in tables))
    titles = dict(zip(tasks, directive.parts("tasks"), strict=False))
    methods = directive.parts("methods")
    if cells := directive.parts("cells"):
        file = options.get("published")
        published = read_json(root / file, Published) if file else None
        return side_by_side(tables, cells, methods=methods, published=published, titles=titles)
    rows = [
        {**row, "task": titles.get(table.task, table.task)}
        for table in tables
        for row in _select_rows(table, methods)
    ]
    known = dict.fromkeys(table.name(row) for table in tables for row in table.rows)
    if unknown := [name for name in methods if name not in known]:
        raise InputError(f"methods: expected some of {' | '.join(known)}, got {' | '.join(unknown)}")
    several = ["task"] if len(tasks) > 1 else []
    return select_columns(rows, directive.parts("columns") or [*several, *tables[0].columns])


def _family(tables: Sequence[Table], rows: Sequence[Row]) -> str:
    """Say how many verdicts are given together, below a table that shows any."""
    if "against" in rows[0]:
        late = " `+1` is one step late." if " +" in rows[0]["against"] else ""
        return f"{sum(len(table.rows) for table in tables)} pairs, not corrected for their number.{late}"
    numbers = [str(table.comparisons) for table in tables if table.comparisons]
    if not numbers or not {"verdict", "time verdict"} & set(rows[0]):
        return ""
    count = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
    of_each = "" if len(numbers) == 1 else ", file by file"
    return f"Of {count} comparisons with dense{of_each}; † does not survive Holm's correction for them."


def _told_apart(tables: Sequence[Table], policies: Sequence[str]) -> list[Table]:
    if len(policies) != len(tables):
        raise InputError(
            f"policies: expected {len(tables)} names, one for each file, got {' | '.join(policies)}"
        )
    tasks: dict[str, str] = {}
    for table, policy in zip(tables, policies, strict=True):
        if tasks.setdefault(policy, table.task) != table.task:
            raise InputError(
                f"policies: expected {policy} to be of {tasks[policy]}, got a file of {table.task}"
            )
    return [replace(table, task=policy) for table, policy in zip(tables, policies, strict=True)]


def _select_rows(table: Table, methods: Sequence[str]) -> list[Row]:
    if not methods:
        return list(table.rows)
    return [row for name in methods for row in table.rows if table.name(row) == name]


def _pair(text: str) -> tuple[str, str]:
    first, colon, second = text.partition(" : ")
    if not colon:
        raise InputError(f"pairs: expected METHOD : METHOD, got {text!r}")
    return first.strip(), second.strip()
