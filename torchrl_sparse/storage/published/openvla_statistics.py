"""Normaliser of states and actions from an OpenVLA-OFT folder's ``dataset_statistics.json`` (arXiv:2502.19645)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.storage.json import read_json

__all__ = ["ACTION_DIM", "STATE_DIM", "Normalization", "read_normalizer"]

Normalization = Literal["bounds_q99", "bounds"]
"""The published code's words: the 1 % and 99 % quantiles become -1 and 1, or the least and the largest number do."""
STATE_DIM, ACTION_DIM = 8, 7
_BOUNDS = {"bounds_q99": ("q01", "q99"), "bounds": ("min", "max")}
_NO_NOOPS = "_no_noops"


def read_normalizer(
    path: Path, unnorm_key: str | None, normalization: Normalization
) -> tuple[str, QuantileNormalizer]:
    """Return the name of the data set, without ``_no_noops``, and its normaliser.

    Args:
        path: the file.
        unnorm_key: name of the data set, with or without ``_no_noops``; None if the file has one only.
        normalization: which statistics the policy was trained with.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming the file, if it has no such data set or no such statistics, or they are not of LIBERO's arm.
    """
    if normalization not in _BOUNDS:
        raise InputError(f"normalization: expected one of {get_args(Normalization)}, got {normalization!r}")
    name, statistics = _statistics(path, unnorm_key)
    bounds = _BOUNDS[normalization]
    action, proprio = statistics.get("action", {}), statistics.get("proprio", {})
    mask = action.get("mask", [True] * ACTION_DIM)
    gripper = [False] * (ACTION_DIM - 1) + [True]
    if mask != [not last for last in gripper]:
        raise InputError(
            f"{path}: action.mask: expected LIBERO's, {ACTION_DIM} times true but for the gripper, the last, got {mask}"
        )
    if not all(proprio.get("mask", [])):
        raise InputError(f"{path}: proprio.mask: expected all true, got {proprio['mask']}")
    try:
        state_low, state_high = (torch.tensor(proprio[bound]) for bound in bounds)
        low, high = (torch.tensor(action[bound]) for bound in bounds)
        normalizer = QuantileNormalizer(state_low, state_high, low, high, torch.tensor(gripper))
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: expected {' and '.join(bounds)} of action and proprio: {error}") from error
    found = len(normalizer.state_low), len(normalizer.action_low)
    if found != (STATE_DIM, ACTION_DIM):
        raise InputError(f"{path}: expected {STATE_DIM} proprio and {ACTION_DIM} action numbers, got {found}")
    return name.removesuffix(_NO_NOOPS), normalizer


def _statistics(path: Path, unnorm_key: str | None) -> tuple[str, dict[str, Any]]:
    """Return the name of the data set, and its statistics."""
    every = read_json(path, dict[str, dict[str, Any]])
    wanted = [unnorm_key, f"{unnorm_key}{_NO_NOOPS}"] if unnorm_key is not None else list(every)
    found = [name for name in wanted if name in every]
    if not found or (unnorm_key is None and len(found) > 1):
        raise InputError(f"{path}: unnorm_key: expected one of {sorted(every)}, got {unnorm_key!r}")
    return found[0], every[found[0]]
