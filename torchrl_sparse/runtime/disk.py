"""Errors for a full disk that name the file and its volume."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["naming_full_disk"]

_FULL = {
    errno.ENOSPC: "no space left",
    errno.EDQUOT: "quota exceeded",
    errno.EFBIG: "file larger than may be",
}
_ROOM = 1 << 20  # bytes; a writer that reports a full disk as something else leaves less


@contextmanager
def naming_full_disk(path: str | os.PathLike) -> Iterator[None]:
    """Turn a full-disk error in the block into an OSError that names the file and its volume.

    >>> with naming_full_disk("log.csv"):
    ...     raise OSError(errno.ENOSPC, "No space left on device")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    OSError: [Errno 28] no space left on the volume /...: 'log.csv'
    """
    try:
        yield
    except Exception as error:
        number, folder = getattr(error, "errno", None), _existing(Path(path).absolute().parent)
        if number not in _FULL and shutil.disk_usage(folder).free < _ROOM:
            number = errno.ENOSPC  # torch, h5py and safetensors have errors of their own for it
        if number not in _FULL:
            raise
        raise OSError(number, f"{_FULL[number]} on the volume {_mount_of(folder)}", str(path)) from error


def _existing(folder: Path) -> Path:
    while not folder.exists():
        folder = folder.parent
    return folder


def _mount_of(folder: Path) -> Path:
    folder = folder.resolve()
    while not folder.is_mount():
        folder = folder.parent
    return folder
