"""Lock that allows one process at a time per output folder."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from torchrl_sparse.runtime.disk import naming_full_disk

__all__ = ["lock_output"]


@contextmanager
def lock_output(out: str | os.PathLike, *, is_file: bool = False) -> Iterator[int]:
    """Lock ``out`` against other processes during the block.

    The lock lies in the folder or, of a file, beside it, and goes with the block, as do folders that it made and nobody filled.
    One whose process has died holds nobody up, unless a process that inherited it still runs: that one is waited for.

    Args:
        out: the folder or the file that the block writes.
        is_file: which of the two.

    Yields:
        The lock's file descriptor, for processes that shall inherit it.

    Raises:
        BlockingIOError: if another process holds it; the message says which, and since when.

    >>> import tempfile
    >>> out = Path(tempfile.mkdtemp()) / "run"
    >>> with lock_output(out):
    ...     [file.name for file in out.iterdir()]
    ['.lock']
    >>> out.exists()
    False
    """
    out = Path(out)
    path = out.with_name(f".{out.name}.lock") if is_file else out / ".lock"
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        with naming_full_disk(path):
            descriptor = _acquire(path, out)
        try:
            yield descriptor
        finally:
            path.unlink()
            os.close(descriptor)
    finally:
        for folder in made:
            with suppress(OSError):  # no longer empty
                folder.rmdir()


@dataclass(frozen=True)
class _Holder:
    pid: int
    host: str
    command: str
    since: str

    @classmethod
    def this(cls) -> _Holder:
        since = datetime.now().astimezone().isoformat(" ", "seconds")
        return cls(os.getpid(), socket.gethostname(), shlex.join(sys.argv), since)

    @property
    def is_dead(self) -> bool:
        """Whether it has certainly ended; of other machines nothing is certain."""
        if self.host != socket.gethostname():
            return False
        with suppress(PermissionError):
            try:
                os.kill(self.pid, 0)
            except ProcessLookupError:
                return True
        return False

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} since {self.since}: {self.command}"


def _acquire(path: Path, out: Path) -> int:
    """Return the descriptor of the locked file, which is the one at ``path``: its last holder may just have removed it."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(descriptor, path, out)
            if path.exists() and os.path.samestat(path.stat(), os.fstat(descriptor)):
                os.truncate(descriptor, 0)
                os.write(descriptor, json.dumps(asdict(_Holder.this())).encode())
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _lock(descriptor: int, path: Path, out: Path) -> None:
    with suppress(BlockingIOError):
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    holder = _read_holder(path)
    if holder is None or not holder.is_dead:
        raise BlockingIOError(
            f"out: {out} is locked by {holder or 'another process'}; expected one that no other run writes"
        )
    print(f"waiting for what {holder} has left running in {out}", flush=True)
    fcntl.flock(descriptor, fcntl.LOCK_EX)


def _read_holder(path: Path) -> _Holder | None:
    """Who holds the lock; None if it has yet to say so."""
    try:
        return _Holder(**json.loads(path.read_bytes()))
    except (OSError, ValueError, TypeError):
        return None
