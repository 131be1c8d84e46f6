"""Malformed files: each is answered or refused in time, within its memory, and by one line that names the file and the key."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tests.torture import binaries
from tests.torture.formats import Format, json_formats
from tests.torture.grammar import Change, changes, damage, hostile_json
from tests.torture.limits import Outcome, run_limited
from tests.torture.report import Verdict

PART = "a malformed file is read"
_TORN = ("cut", "empty", "two documents")
REFUSALS = (
    "InputError",
    "ValueError",
    "FileNotFoundError",
    "IsADirectoryError",
    "CheckpointError",
    "MaskError",
)


@dataclass(frozen=True)
class Case:
    """A malformed file.

    Attributes:
        subject: the kind of file.
        name: of what is wrong with it.
        keys: of which an error must name one; None where the file may also be answered.
        write: writes it into an empty folder.
        read: reads what lies in that folder.
    """

    subject: str
    name: str
    keys: tuple[str, ...] | None
    write: Callable[[Path], None]
    read: Callable[[Path], Any]


def torture_files(seed: int, share: float = 1.0) -> Iterator[Verdict]:
    """Read malformed files of every kind, in random order.

    Args:
        seed: of random bytes, of the choice and of the order.
        share: of all cases that is tried.
    """
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as work:
        cases = list(_cases(Path(work), rng))
        for case in rng.sample(cases, round(share * len(cases))):
            yield _try(case, Path(work) / "case")


def _try(case: Case, folder: Path) -> Verdict:
    folder.mkdir()
    try:
        case.write(folder)
        fault = fault_of(run_limited(partial(case.read, folder)), str(folder), case.keys)
    finally:
        shutil.rmtree(folder)
    return Verdict(PART, case.subject, case.name, fault)


def fault_of(outcome: Outcome, where: str, keys: tuple[str, ...] | None) -> str | None:
    """Say what is wrong with an outcome; None if it is an answer, or a refusal in one line that names ``where`` and a key."""
    if outcome.error is None:
        return None if keys is None else f"expected an error that names {' or '.join(keys)}, got an answer"
    said = f"{outcome.error}: {outcome.text[:300]!r}"
    if outcome.error not in REFUSALS:
        return f"expected a refusal, got {said}"
    if "\n" in outcome.text:
        return f"expected one line, got {said}"
    if where not in outcome.text:
        return f"expected the file to be named, got {said}"
    if keys and not any(key in outcome.text for key in keys):
        return f"expected {' or '.join(keys)} to be named, got {said}"
    return None


def _cases(work: Path, rng: random.Random) -> Iterator[Case]:
    for number, kind in enumerate(json_formats()):
        valid = work / f"json{number}"
        valid.mkdir()
        kind.write(valid)
        yield from _json_cases(kind, valid, rng)
    for number, kind in enumerate(binaries.KINDS):
        valid = work / f"binary{number}"
        valid.mkdir()
        kind.write(valid)
        for change in kind.changes():
            keys = None if change.key is None else (change.key,)
            yield Case(
                kind.name, change.name, keys, partial(_edited, valid, kind.file, change.content), kind.read
            )
        whole = (valid / kind.file).read_bytes()
        yield from _damaged(kind.name, valid, kind.file, kind.read, damage(whole, rng))


def _json_cases(kind: Format, valid: Path, rng: random.Random) -> Iterator[Case]:
    document = kind.document(valid)
    for change in changes(document, free=kind.free, optional=kind.optional):
        keys = None if change.key is None else (change.key, *kind.sections)
        yield Case(kind.name, change.name, keys, partial(_changed, kind, valid, change.content), kind.read)
    whole = (valid / kind.file).read_bytes()
    texts = [*damage(whole, rng), *hostile_json(document)]
    if kind.line is not None:
        texts = [replace(text, key=None) if text.name.startswith(_TORN) else text for text in texts]
    yield from _damaged(kind.name, valid, kind.file, kind.read, texts)


def _damaged(name: str, valid: Path, file: str, read: Callable, texts: Iterator[Change]) -> Iterator[Case]:
    for text in texts:
        keys = None if text.key is None else (text.key,)
        yield Case(name, text.name, keys, partial(_replaced, valid, file, text.content), read)
    yield Case(name, "is a folder", ("",), partial(_made_folder, valid, file), read)


def _changed(kind: Format, valid: Path, document: Any, folder: Path) -> None:
    shutil.copytree(valid, folder, dirs_exist_ok=True)
    kind.put(folder, document)


def _replaced(valid: Path, file: str, content: bytes, folder: Path) -> None:
    shutil.copytree(valid, folder, dirs_exist_ok=True)
    (folder / file).write_bytes(content)


def _edited(valid: Path, file: str, edit: Callable[[Path], None], folder: Path) -> None:
    shutil.copytree(valid, folder, dirs_exist_ok=True)
    edit(folder / file)


def _made_folder(valid: Path, file: str, folder: Path) -> None:
    shutil.copytree(valid, folder, dirs_exist_ok=True)
    (folder / file).unlink()
    (folder / file).mkdir()
