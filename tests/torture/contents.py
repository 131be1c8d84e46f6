"""What a run left in its folder, without times and random names: what a resumed run shares with one that was never killed."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from torch.utils import _pytree as pytree

_TIMES = {
    "machine",
    "latency",
    "latency_s",
    "own_latency_s",
    "planning_s",
    "speedup_vs_dense",
    "speedup_ci95",
}
_PICTURES = {".png", ".mp4"}
_RUN_ID = re.compile(r"-[0-9a-f]{8}\b")


def contents(folder: Path) -> list[tuple[str, Any]]:
    """Return every file of a folder with what it holds; temporary files that were left behind are files too."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return sorted((_plain_name(path, folder), _content(path)) for path in files)


def difference(found: list[tuple[str, Any]], expected: list[tuple[str, Any]]) -> str | None:
    """Say where two contents differ; None if they do not."""
    names, wanted = [name for name, _ in found], [name for name, _ in expected]
    if names != wanted:
        return f"expected files {sorted(set(wanted) - set(names))} too, and none of {sorted(set(names) - set(wanted))}"
    for (name, one), (_, other) in zip(found, expected, strict=True):
        if one != other:
            return f"{name} differs: {_shorten(one, other)}"
    return None


def _shorten(one: str, other: str) -> str:
    at = next((i for i, pair in enumerate(zip(one, other, strict=False)) if pair[0] != pair[1]), 0)
    start = max(0, at - 40)
    return f"got ...{one[start : at + 40]!r}, expected ...{other[start : at + 40]!r} ({len(one)}, {len(other)} characters)"


def _plain_name(path: Path, folder: Path) -> str:
    return _RUN_ID.sub("-ID", str(path.relative_to(folder)))


def _content(path: Path) -> str:
    if path.suffix in _PICTURES:
        return "a picture"
    if path.name.startswith("."):  # a temporary file, perhaps torn
        return _digest(path)
    return _READERS.get(path.suffix, _digest)(path)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _json(path: Path) -> str:
    return json.dumps(_timeless(json.loads(path.read_text())), sort_keys=True)


def _json_lines(path: Path) -> str:
    """Several workers finish in any order."""
    return "\n".join(
        sorted(json.dumps(_timeless(json.loads(line))) for line in path.read_text().splitlines())
    )


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if key not in _TIMES}
    if isinstance(value, list):
        return [_timeless(entry) for entry in value]
    return _RUN_ID.sub("-ID", value) if isinstance(value, str) else value


def _csv(path: Path) -> str:
    """Of a scalar that is a time its steps alone count, each once; of a table of trials all but latencies and run ids."""
    with open(path, newline="") as file:
        rows = list(csv.reader(file))
    if path.stem == "seconds_per_step":
        rows = [row[:1] for row in rows]
    if path.name == "trials.csv":
        kept = [
            column
            for column, name in enumerate(rows[0])
            if not re.search(r"latency|speedup|planning|run", name)
        ]
        rows = [[row[column] for column in kept] for row in rows]
    return "\n".join(map(",".join, rows))


def _hdf5(path: Path) -> str:
    lines: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, item: lines.append(f"{name} {dict(item.attrs)} {_array(item)}"))
        lines.append(str(dict(file.attrs)))
    return "\n".join(sorted(lines))


def _array(item: Any) -> str:
    if not isinstance(item, h5py.Dataset):
        return "group"
    values = np.asarray(item)
    return f"{values.dtype} {values.shape} {hashlib.sha256(values.tobytes()).hexdigest()[:16]}"


def _checkpoint(path: Path) -> str:
    leaves, structure = pytree.tree_flatten(torch.load(path, weights_only=True))
    values = [_digest_of(leaf) if isinstance(leaf, torch.Tensor) else repr(leaf) for leaf in leaves]
    return f"{structure} {values}"


def _digest_of(tensor: torch.Tensor) -> str:
    raw = tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
    return f"{tensor.dtype} {tuple(tensor.shape)} {hashlib.sha256(raw).hexdigest()[:16]}"


_READERS = {
    ".json": _json,
    ".jsonl": _json_lines,
    ".csv": _csv,
    ".h5": _hdf5,
    ".pt": _checkpoint,
}
