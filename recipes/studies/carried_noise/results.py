"""``carried_noise_TASK.json``: how strongly actions depend on the initial noise, under several samplers."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from recipes.studies.carried_noise.chains import CarriedNoise
from torchrl_sparse.storage.json import read_json, write_json

__all__ = ["CarriedNoiseResults", "carried_noise_rows", "load_carried_noise", "save_carried_noise"]


@dataclass(frozen=True)
class CarriedNoiseResults:
    """The content of a ``carried_noise_TASK.json``.

    Attributes:
        policy: its fingerprint.
        policy calls, draws: how many were answered, and how often each.
        seed: of the calls and the noise.
        chains: sampler -> what was measured.
    """

    carried_noise: Literal[1]
    task: str
    policy: str
    queries: int
    draws: int
    seed: int
    chains: dict[str, CarriedNoise]


def load_carried_noise(path: str | os.PathLike) -> CarriedNoiseResults:
    """Read a ``carried_noise_TASK.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another kind.
    """
    return read_json(path, CarriedNoiseResults)


def save_carried_noise(results: CarriedNoiseResults, path: str | os.PathLike) -> Path:
    """Write a ``carried_noise_TASK.json`` in one piece or not at all; return the path."""
    return write_json(path, results)


def carried_noise_rows(results: CarriedNoiseResults) -> list[dict[str, str]]:
    """Return one row per sampler: correlation of its last prediction with its initial noise, and its actions' statistics."""
    return [
        {
            "sampler": name,
            "correlation with the first noise": f"{chain.correlation[-1]:+.2f}",
            "spread": f"{chain.spread:.3f}",
            "error": f"{chain.error:.3f}",
        }
        for name, chain in results.chains.items()
    ]
