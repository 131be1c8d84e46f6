"""Conversion of Diffusion Policy's published human demonstrations of Push-T (arXiv:2303.04137) to robomimic's layout.

The source is ``pusht_cchi_v7_replay.zarr`` without its images, as an ``.npz`` with one row a step of all episodes end to end:
``state`` f32 [N, 5] (agent x, y; block x, y; pixels; block angle, rad), ``keypoint`` f32 [N, 9, 2] (pixels), ``action``
f32 [N, 2] (the agent's target, pixels) and ``episode_ends`` i64 [E], the row after each episode's last.

Observations are made again from the states, as `PushTEnv` observes: the recorded keypoints of an episode's first rows are up to
2 pixels off, all others equal to rounding.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from zipfile import BadZipFile, is_zipfile

import numpy as np

from torchrl_sparse.data.hdf5_files import new_hdf5
from torchrl_sparse.data.hdf5_writer import lay_out
from torchrl_sparse.envs.pusht import KEYPOINTS, block_keypoints
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError

__all__ = ["convert_pusht"]

_ROWS = {"state": (5,), "keypoint": KEYPOINTS.shape, "action": (2,)}
# Pixels between a recorded keypoint and the same state's here; other keypoints or another order of the state are far off
_TOLERANCE = 5.0
# What zipfile, zlib and numpy raise of bytes that are not those that were written
_DAMAGES = (
    BadZipFile,
    zlib.error,
    ValueError,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    MemoryError,
)


def convert_pusht(path: str | Path, out: str | Path) -> int:
    """Write the published demonstrations to a file for `read_demos`.

    ``states`` are the recorded ones, for setting the simulator: angle first, then position. A kill leaves either the whole
    ``out`` or none.

    Args:
        path: the ``.npz``.
        out: the HDF5 file to write.

    Returns:
        The number of demonstrations.

    Raises:
        FileNotFoundError: if there is no ``path``.
        InputError: naming file and array, if it is not such a file, or its keypoints are not those of its states.

    Examples:
        >>> convert_pusht("pusht_human.npz", "data/pusht_human.h5")  # doctest: +SKIP
        206
    """
    path, out = Path(path), Path(out)
    arrays = _read(path)
    ends = arrays["episode_ends"].tolist()
    spans = {f"demo_{i}": span for i, span in enumerate(pairwise([0, *ends]))}
    observed = _observations(path, arrays)
    task = find_task("PushT")
    attributes = {
        "total": ends[-1],
        "env_args": task.demonstrator.env_args(task),
        "collection": {"source": path.name, "operator": "human"},
    }
    with new_hdf5(out) as file:
        data = lay_out(file, spans, attributes)
        for name, (first, end) in spans.items():
            data[name].attrs["num_samples"] = end - first
            data[name]["states"] = arrays["state"][first:end]
            data[name]["actions"] = arrays["action"][first:end]
            data[name]["obs/state"] = observed[first:end]
    return len(ends)


def _observations(path: Path, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the state of `PushTEnv`, f64 [N, 20], in each row."""
    agent, block, angle = np.split(arrays["state"].astype(np.float64), [2, 4], axis=1)
    keypoints = np.stack([block_keypoints(*pose) for pose in zip(block, angle[:, 0], strict=True)])
    if (far := np.abs(keypoints - arrays["keypoint"]).max()) > _TOLERANCE:
        raise InputError(f"{path}, keypoint: expected them where 'state' puts them, got {far:.1f} pixels off")
    return np.concatenate([keypoints.reshape(len(agent), -1), agent], axis=1)


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a file of demonstrations, got none")
    if not is_zipfile(path):
        raise InputError(f"{path}: expected a complete npz file, got another or a part of one")
    names = (*_ROWS, "episode_ends")
    try:
        with np.load(path, allow_pickle=False) as file:
            if not (missing := {*names} - {*file}):
                arrays = {name: file[name] for name in names}
            found = sorted(file)
    except _DAMAGES as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: expected a complete npz file, got a damaged one: {reason}") from error
    if missing:
        raise InputError(f"{path}: expected an array {min(missing)!r}, got {found}")
    _check(path, arrays)
    return arrays


def _check(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        kinds, words = ("iu", "whole numbers") if name == "episode_ends" else ("iuf", "numbers")
        if array.dtype.kind not in kinds:
            raise InputError(f"{path}, {name}: expected {words}, got {array.dtype}")
    ends = arrays["episode_ends"]
    if ends.ndim != 1 or not len(ends) or (np.diff(ends, prepend=0) < 1).any():
        raise InputError(f"{path}, episode_ends: expected increasing rows above 0, got {ends.tolist()}")
    for name, shape in _ROWS.items():
        if arrays[name].shape != (expected := (int(ends[-1]), *shape)):
            raise InputError(f"{path}, {name}: expected shape {expected}, got {arrays[name].shape}")
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}, {name}: expected finite numbers, got others")
