"""A diffusion policy as two files: ``config.json`` and ``model.safetensors``. Neither can hold anything that executes.

::

    {"format": "torchrl_sparse.diffusion_policy/1",
     "network": {arguments of TransformerForDiffusion},
     "schedule": {arguments of NoiseSchedule}}

Network weights are fp16, normalisation constants fp32.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_sparse.data.normalize import Normalizer
from torchrl_sparse.files import atomic_path
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

FORMAT = "torchrl_sparse.diffusion_policy/1"
_FIELDS = {"format", "network", "schedule"}
_NETWORK, _NORMALIZER = "network.", "normalizer."


def write_pretrained(
    path: Path, *, network: TransformerForDiffusion, normalizer: Normalizer, schedule: dict[str, Any]
) -> None:
    """Writes both files into the folder ``path``, each in one piece or not at all."""
    tensors = {_NETWORK + name: value.half() for name, value in network.state_dict().items()}
    tensors |= {_NORMALIZER + name: value for name, value in normalizer.state_dict().items()}
    config = {"format": FORMAT, "network": network.config, "schedule": schedule}
    with atomic_path(path / "model.safetensors") as temporary:
        save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, temporary)
    with atomic_path(path / "config.json") as temporary:
        temporary.write_text(json.dumps(config, indent=2) + "\n")


def read_pretrained(path: Path) -> tuple[TransformerForDiffusion, Normalizer, dict[str, Any]]:
    """Network (f32, eval mode), normaliser and the arguments of the schedule from the folder ``path``.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: naming the file, what was expected and what came.
    """
    config = _read_config(path / "config.json")
    tensors = _read_tensors(path / "model.safetensors")
    try:
        network = TransformerForDiffusion(**config["network"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path / 'config.json'}: network: {error}") from error
    network_tensors = _take(tensors, _NETWORK)
    normalizer_tensors = _take(tensors, _NORMALIZER)
    expected_normalizer = {
        f"{name}_{part}": (size,)
        for name, size in (("state", network.cond_dim), ("action", network.input_dim))
        for part in ("scale", "offset")
    }
    expected_network = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    where = path / "model.safetensors"
    _check_tensors(where, _NETWORK, network_tensors, expected_network)
    _check_tensors(where, _NORMALIZER, normalizer_tensors, expected_normalizer)
    if tensors:
        raise ValueError(
            f"{where}: expected tensors under {_NETWORK!r} and {_NORMALIZER!r}, got {sorted(tensors)}"
        )
    network.load_state_dict({name: value.float() for name, value in network_tensors.items()})
    return network.eval(), Normalizer(**normalizer_tensors), config["schedule"]


def _read_config(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FileNotFoundError(f"policy: expected a file {path}")
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected a complete JSON file, got: {error}") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        found = config.get("format") if isinstance(config, dict) else type(config).__name__
        raise ValueError(f"{path}: format: expected {FORMAT!r}, got {found!r}")
    if set(config) != _FIELDS:
        raise ValueError(f"{path}: expected the fields {sorted(_FIELDS)}, got {sorted(config)}")
    return config


def _read_tensors(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise FileNotFoundError(f"policy: expected a file {path}")
    try:
        return load_file(path)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{path}: expected a complete safetensors file, got: {error}") from error


def _take(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Removes the tensors under ``prefix`` and returns them without it."""
    names = [name for name in tensors if name.startswith(prefix)]
    return {name.removeprefix(prefix): tensors.pop(name) for name in names}


def _check_tensors(path: Path, prefix: str, found: dict[str, Tensor], expected: dict[str, tuple]) -> None:
    missing, extra = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or extra:
        raise ValueError(f"{path}: tensors under {prefix!r}: missing {missing}, unexpected {extra}")
    for name, shape in expected.items():
        if tuple(found[name].shape) != shape:
            raise ValueError(
                f"{path}: {prefix}{name}: expected shape {shape}, got {tuple(found[name].shape)}"
            )
        if not torch.isfinite(found[name]).all():
            raise ValueError(f"{path}: {prefix}{name}: expected finite numbers, got NaN or infinity")
