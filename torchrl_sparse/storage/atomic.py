"""Atomic file writing, so that a reader never sees half a file."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchrl_sparse.runtime.disk import naming_full_disk

__all__ = ["atomic_path"]


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Lend a temporary path beside ``path``, moved onto it if the block succeeds and removed if it raises. What a kill leaves
    behind is overwritten by the next try.

    The folder is made if it is missing. A full disk raises an OSError that names the file and its volume. The temporary file
    keeps the suffix, since writers choose a format by it.

    >>> import tempfile
    >>> folder = tempfile.mkdtemp()
    >>> with atomic_path(Path(folder) / "note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> [file.name for file in Path(folder).iterdir()]
    ['note.txt']
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        with naming_full_disk(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.chmod(temporary, 0o644)  # some writers make files that only their owner can read
        os.replace(temporary, path)
    except BaseException:
        with suppress(FileNotFoundError):
            temporary.unlink()
        raise
