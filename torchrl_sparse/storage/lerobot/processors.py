"""Processor files of LeRobot: statistics as affine maps, and how instructions become tokens."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import parse_json, read_json
from torchrl_sparse.storage.tensors import read_tensors

__all__ = ["Affine", "Processors", "TokenizerStep", "read_processors"]

_PRE, _POST = "policy_preprocessor.json", "policy_postprocessor.json"
_IDLE = ("to_batch_processor", "device_processor")
_MODES = {  # statistics that a mode reads: of MEAN_STD mean and spread, of the others both ends of [-1, 1]
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}


@dataclass(frozen=True)
class Affine:
    """``normalised = (x - shift) * scale + offset``, each of the feature's shape."""

    shift: Tensor
    scale: Tensor
    offset: Tensor


@dataclass(frozen=True)
class TokenizerStep:
    """How an instruction becomes token ids."""

    tokenizer_name: str | None = None
    max_length: int = 512
    task_key: str = "task"
    padding_side: str = "right"
    padding: str = "max_length"
    truncation: bool = True


@dataclass(frozen=True)
class Processors:
    """What the processor files say.

    Attributes:
        maps: of each input and of ``"action"``.
        tokenizer: of instructions.
    """

    maps: dict[str, Affine]
    tokenizer: TokenizerStep


@dataclass(frozen=True)
class _Step:
    registry_name: str
    config: dict[str, Any]
    state_file: str | None = None


@dataclass(frozen=True)
class _File:
    name: str
    steps: list[_Step]


@dataclass(frozen=True)
class _Feature:
    type: str
    shape: list[int]


@dataclass(frozen=True)
class _Normalisation:
    features: dict[str, _Feature]
    norm_map: dict[str, str]
    eps: float = 1e-8
    normalize_observation_keys: list[str] | None = None


def read_processors(folder: Path, shapes: dict[str, tuple[int, ...]]) -> Processors:
    """Read both processor files.

    Args:
        folder: of the policy.
        shapes: of each feature that is normalised, by LeRobot's name.

    Raises:
        FileNotFoundError: if a file is not there.
        InputError: naming file and entry, what was expected and what came.
    """
    before, after = (
        _steps(folder / _PRE, "normalizer_processor"),
        _steps(folder / _POST, "unnormalizer_processor"),
    )
    rename = before.get("rename_observations_processor", _Step("", {})).config.get("rename_map")
    if rename:
        raise InputError(
            f"{folder / _PRE}: rename_map: expected none, got {rename}; rename the observations instead"
        )
    if "tokenizer_processor" not in before:
        raise InputError(f"{folder / _PRE}: steps: expected a tokenizer_processor, got {', '.join(before)}")
    tokenizer = parse_json(
        json.dumps(before["tokenizer_processor"].config),
        TokenizerStep,
        f"{folder / _PRE}: tokenizer_processor",
    )
    if tokenizer.padding_side != "right":
        raise InputError(
            f"{folder / _PRE}: padding_side: expected 'right', as CLIP is trained, got {tokenizer.padding_side!r}"
        )
    maps = _maps(folder / _PRE, before["normalizer_processor"], shapes)
    back = _maps(folder / _POST, after["unnormalizer_processor"], {"action": shapes["action"]})["action"]
    pairs = ((getattr(maps["action"], part), getattr(back, part)) for part in ("shift", "scale", "offset"))
    if not all(torch.equal(*pair) for pair in pairs):
        raise InputError(
            f"{folder / _POST}: action: expected the statistics of {_PRE}, got others; save both of one training"
        )
    return Processors(maps, tokenizer)


def _steps(file: Path, needed: str) -> dict[str, _Step]:
    if not file.is_file():
        raise FileNotFoundError(
            f"expected a file {file}, got none; LeRobot writes it beside the weights, older versions' policies are migrated by "
            "its migrate_policy_normalization.py"
        )
    known = (*_IDLE, needed, "rename_observations_processor", "tokenizer_processor")
    steps: dict[str, _Step] = {}
    for step in read_json(file, _File).steps:
        if step.registry_name not in known or step.registry_name in steps:
            raise InputError(
                f"{file}: registry_name: expected each of {', '.join(known)} at most once, got {step.registry_name!r}"
            )
        steps[step.registry_name] = step
    if needed not in steps:
        raise InputError(f"{file}: steps: expected a {needed}, got {', '.join(steps) or 'none'}")
    return steps


def _maps(file: Path, step: _Step, shapes: dict[str, tuple[int, ...]]) -> dict[str, Affine]:
    settings = parse_json(json.dumps(step.config), _Normalisation, f"{file}: {step.registry_name}")
    if settings.normalize_observation_keys is not None:
        raise InputError(
            f"{file}: normalize_observation_keys: expected none, got {settings.normalize_observation_keys}"
        )
    statistics: dict[str, Tensor] = {}
    if step.state_file is not None:
        if Path(step.state_file).name != step.state_file:
            raise InputError(f"{file}: state_file: expected a name, got {step.state_file!r}")
        statistics = read_tensors(file.parent / step.state_file)
        file = file.parent / step.state_file
    return {name: _map(file, name, shape, settings, statistics) for name, shape in shapes.items()}


def _map(
    file: Path, name: str, shape: tuple[int, ...], settings: _Normalisation, statistics: dict[str, Tensor]
) -> Affine:
    # As LeRobot has it, whatever is not named stays as it is.
    feature, zeros = settings.features.get(name), torch.zeros(_channels(shape))
    mode = "IDENTITY" if feature is None else settings.norm_map.get(feature.type, "IDENTITY")
    known = any(key.rpartition(".")[0] == name for key in statistics)
    if mode == "IDENTITY" or not known:
        return Affine(zeros, zeros + 1, zeros)
    if mode not in _MODES:
        raise InputError(f"{file}: norm_map: expected one of IDENTITY, {', '.join(_MODES)}, got {mode!r}")
    first, second = (_statistic(file, f"{name}.{part}", shape, statistics) for part in _MODES[mode])
    if mode == "MEAN_STD":
        return Affine(first, 1 / (second + settings.eps), zeros)
    extent = second - first
    extent = torch.where(extent == 0, torch.full_like(extent, settings.eps), extent)
    return Affine(first, 2 / extent, zeros - 1)


def _statistic(file: Path, key: str, shape: tuple[int, ...], statistics: dict[str, Tensor]) -> Tensor:
    expected, found = _channels(shape), statistics.get(key)
    if found is None:
        raise InputError(f"{file}: {key}: expected this statistic, got none")
    if found.numel() != expected[0] or found.numel() != max(found.shape, default=0):
        raise InputError(f"{file}: {key}: expected shape {list(expected)}, got {list(found.shape)}")
    return found.float().reshape(expected)


def _channels(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a feature's statistics: of images, one number for each channel."""
    return (shape[0], 1, 1) if len(shape) == 3 else shape
