"""Errors for unreadable published files: one error type, one line, for any defect."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchrl_sparse.errors import InputError

__all__ = ["CheckpointError", "naming_faults"]

_MAX_TEXT = 600


class CheckpointError(InputError):
    """Error for an unreadable checkpoint; the message names the file, what was expected and what came."""


@contextmanager
def naming_faults(path: Path) -> Iterator[None]:
    """Turn any error in reading the file or folder ``path``, except its absence, into a `CheckpointError` that names it.

    Files from elsewhere may be wrong in ways that nobody thought of, so any exception counts as theirs.

    >>> with naming_faults(Path("a.ckpt")):
    ...     {}["cfg"]
    Traceback (most recent call last):
    ...
    torchrl_sparse.storage.published.faults.CheckpointError: a.ckpt: expected a checkpoint, got KeyError: 'cfg'
    """
    try:
        yield
    except (FileNotFoundError, MemoryError):
        raise
    except ValueError as error:
        raise _report(path, str(error)) from error
    except Exception as error:
        raise _report(path, f"expected a checkpoint, got {type(error).__name__}: {error}") from error


def _report(path: Path, text: str) -> CheckpointError:
    line = textwrap.shorten(text, _MAX_TEXT, placeholder=" ...")
    return CheckpointError(line if line.startswith(str(path)) else f"{path}: {line}")
