"""Hostile archives: nothing in a checkpoint is executed or written anywhere, and none exhausts whoever reads it."""

from __future__ import annotations

import os
import pickle
import random
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import dill
import torch

from tests.storage.published.checkpoints import LowDimPolicy, write_checkpoint
from tests.torture.files import fault_of
from tests.torture.limits import run_limited
from tests.torture.report import Verdict
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

PART = "a hostile archive is read"
CANARY = "executed"
"""File that a payload makes where it runs."""


class Payload:
    """Calls a function when Python unpickles it."""

    def __init__(self, call: Callable, *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple:
        return self.call, self.arguments


class StateSetter(dict):
    """Has its state set by a function when Python unpickles it."""

    def __init__(self, call: Callable, argument: Any) -> None:
        self.call, self.argument = call, argument

    def __reduce__(self) -> tuple:
        return dict, (), self.argument, None, None, self.call


def payloads(canary: Path) -> dict[str, Any]:
    """Return objects that make the file ``canary``, by how they do."""
    import subprocess

    code, shell = f"open({str(canary)!r}, 'w').close()", f"touch {canary}"
    return {
        "os.system": Payload(os.system, shell),
        "eval": Payload(eval, code),
        "exec": Payload(exec, code),
        "subprocess": Payload(subprocess.call, ["touch", str(canary)]),
        "open": Payload(open, str(canary), "w"),
        "os.mkdir": Payload(os.mkdir, str(canary)),
        "pickle in a pickle": Payload(pickle.loads, pickle.dumps(Payload(os.system, shell))),
        "dill in a pickle": Payload(dill.loads, dill.dumps(Payload(exec, code))),
        "method of a result": Payload(Path(canary).touch),
        "state of a dict": StateSetter(os.system, shell),
        "map": Payload(list, Payload(map, os.system, [shell])),
    }  # fmt: skip


def raw_pickles(canary: Path) -> dict[str, bytes]:
    """Return pickles written opcode by opcode, as no pickler writes them."""
    shell = f"touch {canary}"
    short = b"\x8c" + bytes([len(shell)]) + shell.encode()  # SHORT_BINUNICODE
    unicode = b"X" + struct.pack("<I", len(shell)) + shell.encode()
    return {
        "GLOBAL": b"\x80\x02cposix\nsystem\n" + unicode + b"\x85R.",
        "STACK_GLOBAL": b"\x80\x04\x8c\x05posix\x8c\x06system\x93" + short + b"\x85R.",
        "STACK_GLOBAL of a memo": b"\x80\x04\x8c\x05posix\x94\x8c\x06system\x94h\x00h\x01\x93" + short + b"\x85R.",
        "INST": b"(" + unicode + b"iposix\nsystem\n.",
        "OBJ": b"(cposix\nsystem\n" + unicode + b"o.",
        "NEWOBJ": b"\x80\x02cposix\nsystem\n" + unicode + b"\x85\x81.",
        "NEWOBJ_EX": b"\x80\x04cposix\nsystem\n" + unicode + b"\x85}\x92.",
        "BUILD": b"\x80\x02cposix\nsystem\n)R" + unicode + b"b.",
        "dotted name": b"\x80\x04\x8c\x02os\x8c\x0bpath.os.nice\x93K\x00\x85R.",
        "name of a known class, then system": b"\x80\x02ccollections\nOrderedDict\n0cposix\nsystem\n" + unicode + b"\x85R.",
    }  # fmt: skip


def exhausting_pickles() -> dict[str, bytes]:
    """Return small pickles of much: nested, shared, deep, or of lying lengths."""
    shared, doubled = b"\x80\x02]q\x00", b""
    for number in range(60):
        doubled += b"(h" + bytes([number]) + b"h" + bytes([number]) + b"tq" + bytes([number + 1])
    number = (1 << 640_000).to_bytes(80_001, "little")
    text = b"X" + struct.pack("<I", 10**6) + b"a" * 10**6 + b"q\x00"
    return {
        "shared tuples": shared + doubled + b".",
        "deep lists": b"\x80\x02" + b"]" * 500_000 + b"a" * 499_999 + b".",
        "deep tuples": b"\x80\x02)" + b"\x85" * 500_000 + b".",
        "a number of 640,000 bits": b"\x80\x02\x8b" + struct.pack("<i", len(number)) + number + b".",
        "a number of 2 GB": b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b".",
        "a decimal number of a million digits": b"\x80\x02L" + b"9" * 10**6 + b"L\n.",
        "a string of 4 GB": b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a.",
        "a string of 2^62 bytes": b"\x80\x04\x8d" + struct.pack("<Q", 2**62) + b"a.",
        "a frame of 2^62 bytes": b"\x80\x04\x95" + struct.pack("<Q", 2**62) + b"N.",
        "a bytearray of 2^40 bytes": b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b".",
        "a string mentioned a thousand times": b"\x80\x02]" + text + b"0(" + b"h\x00" * 1_000 + b"e.",
        "a memo at 4 billion": b"\x80\x02]r" + struct.pack("<I", 2**32 - 1) + b".",
        "a list in itself": b"\x80\x02]q\x00h\x00a.",
        "a million marks": b"\x80\x02" + b"(" * 10**6 + b".",
        "a million pushes": b"\x80\x02" + b"N2" * 10**6 + b".",
        "protocol 255": b"\x80\xffN.",
    }  # fmt: skip


def torture_archives(seed: int = 0, share: float = 1.0) -> Iterator[Verdict]:
    """Read hostile archives; the payloads are shown to work on Python's own pickle first.

    Args:
        seed: of the choice and of the order.
        share: of them that is tried.
    """
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as work:
        canary = Path(work) / CANARY
        pickle.loads(pickle.dumps(Payload(os.system, f"touch {canary}")))
        if not canary.exists():
            raise RuntimeError("expected the payload to work on Python's own pickle, it did not")
        canary.unlink()
        whole = write_checkpoint(Path(work) / "whole.ckpt", LowDimPolicy())
        archives = list(_archives(whole, canary))
        for name, write in rng.sample(archives, round(share * len(archives))):
            yield _try(name, write, Path(work) / "case", canary)


def _try(name: str, write: Callable[[Path], None], folder: Path, canary: Path) -> Verdict:
    folder.mkdir()
    path = folder / "latest.ckpt"
    write(path)
    before = _files(canary.parent)
    keys = None if name.startswith("harmless") else ("",)
    outcome = run_limited(partial(_read_and_save, path, folder / "saved"))
    fault = fault_of(outcome, str(path), keys)
    shutil.rmtree(folder / "saved", ignore_errors=True)
    if new := _files(canary.parent) - before:
        fault = f"expected nothing to be executed or unpacked, got {sorted(new)}"
        canary.unlink(missing_ok=True)
    shutil.rmtree(folder)
    return Verdict(PART, name.partition(":")[0], name.partition(": ")[2], fault)


def _read_and_save(path: Path, target: Path) -> None:
    DiffusionPolicy.from_diffusion_policy(path).save_pretrained(target)


def _files(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def _archives(whole: Path, canary: Path) -> Iterator[tuple[str, Callable[[Path], None]]]:
    """Yield the name ``kind: case`` of every archive and what writes it."""
    places = {
        "configuration": ("cfg",),
        "weights": ("state_dicts", "ema_model", "model.head.bias"),
        "optimizer": ("state_dicts", "optimizer"),
        "unknown entry": ("extra",),
        "inner pickle": ("pickles", "epoch"),
    }
    for how, payload in payloads(canary).items():
        for place, path in places.items():
            inside = dill.dumps(payload) if place == "inner pickle" else payload
            yield f"payload in the {place}: {how}", partial(_write_payload, path, inside)
    for how, data in raw_pickles(canary).items():
        yield f"payload by opcode: {how}", partial(_write_entries, whole, {"data.pkl": data})
        yield f"payload by opcode: {how}, inner", partial(_write_payload, places["inner pickle"], data)
    for how, data in exhausting_pickles().items():
        yield f"small pickle of much: {how}", partial(_write_entries, whole, {"data.pkl": data})
        yield f"harmless or refused: {how}, inner", partial(_write_payload, places["inner pickle"], data)
    for how, change in _lies().items():
        yield f"sizes that lie: {how}", partial(write_checkpoint, policy=LowDimPolicy(), change=change)
    for how, write in _zips(whole, canary).items():
        yield f"zip archive: {how}", write


def _lies() -> dict[str, Callable[[dict], None]]:
    """Return changes of a payload whose tensors say that they are larger than their bytes."""
    one = torch.zeros(1)
    storage = one._typed_storage()

    def rebuilt(shape: tuple[int, ...], stride: tuple[int, ...]) -> Payload:
        return Payload(torch._utils._rebuild_tensor_v2, storage, 0, shape, stride, False, {})

    lies = {
        "a terabyte from one number": {"model.head.bias": one.expand(2**38)},
        "60,000 actions": {"model.pos_emb": one.expand(1, 60_000, 32)},
        "a width of 8,192": {
            "model.pos_emb": one.expand(1, 10, 8192),
            "model.input_emb.weight": one.expand(8192, 10),
        },
        "a shape of 80,000 bits": {"model.head.bias": rebuilt((1 << 80_000,), (0,))},
        "a stride of 80,000 bits": {"model.head.bias": rebuilt((1, 1), (1 << 80_000, 1))},
        "a shape of 10,000 ones": {"model.head.bias": rebuilt((1,) * 10_000, (1,) * 10_000)},
        "3,000 layers": {f"model.decoder.layers.{i}.norm1.weight": torch.zeros(32) for i in range(3_000)},
        "layer 4 billion": {f"model.decoder.layers.{2**32}.norm1.weight": torch.zeros(32)},
        "100,000 tensors": {f"model.{i}": one for i in range(100_000)},
    }
    return {how: partial(_add_weights, tensors) for how, tensors in lies.items()}


def _add_weights(tensors: dict[str, Any], payload: dict) -> None:
    payload["state_dicts"]["ema_model"].update(tensors)


def _write_payload(place: tuple[str, ...], value: Any, path: Path) -> None:
    def put(payload: dict) -> None:
        for key in place[:-1]:
            payload = payload[key]
        payload[place[-1]] = value

    write_checkpoint(path, LowDimPolicy(), change=put)


def _write_entries(whole: Path, replaced: dict[str, bytes], path: Path, **options: Any) -> None:
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w", **options) as new:
        for name in old.namelist():
            new.writestr(name, replaced.get(Path(name).name, old.read(name)))


def _zips(whole: Path, canary: Path) -> dict[str, Callable[[Path], None]]:
    return {
        "entries are compressed": partial(_write_entries, whole, {}, compression=zipfile.ZIP_DEFLATED),
        "a pickle unfolds a thousandfold": partial(
            _write_entries, whole, {"data.pkl": bytes(12 << 20)}, compression=zipfile.ZIP_DEFLATED
        ),
        "a pickle of LZMA": partial(_write_entries, whole, {}, compression=zipfile.ZIP_LZMA),
        "a path that leads up": partial(_write_extra, whole, "../../executed", b"x"),
        "an absolute path": partial(_write_extra, whole, str(canary), b"x"),
        "a link": partial(_write_link, whole, "archive/data/0", "/etc/passwd"),
        "two pickles": partial(_write_extra, whole, "other/data.pkl", b"\x80\x02N."),
        "an entry twice": partial(_write_twice, whole),
        "a hundred thousand entries": _write_many,
        "an entry beyond the file": partial(_patched, whole, 42, struct.pack("<I", 2**31)),
        "an entry that is encrypted": partial(_patched, whole, 8, struct.pack("<H", 1)),
    }


def _write_extra(whole: Path, name: str, data: bytes, path: Path) -> None:
    """Leave out the weights and add an entry; the archive is then refused, whatever the entry does."""
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.namelist():
            if "/data/" not in entry:
                new.writestr(entry, old.read(entry))
        new.writestr(name, data)


def _write_link(whole: Path, name: str, target: str, path: Path) -> None:
    info = zipfile.ZipInfo(name)
    info.external_attr = 0o120777 << 16
    _write_extra(whole, info, target.encode(), path)


def _write_twice(whole: Path, path: Path) -> None:
    """The first of two pickles of the same name is harmless."""
    import warnings

    _write_entries(whole, {}, path)
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        name = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        archive.writestr(name, b"\x80\x02cposix\nsystem\n.")


def _write_many(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(100_000):
            archive.writestr(str(number), b"")


def _patched(whole: Path, at: int, data: bytes, path: Path) -> None:
    """Change a field of the first entry in the archive's table of contents."""
    content = bytearray(whole.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + at : entry + at + len(data)] = data
    path.write_bytes(content)
