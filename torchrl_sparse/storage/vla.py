"""A vision-language-action policy as two files: ``config.json`` and ``model.safetensors``. Neither can hold code.

::

    {"format": "torchrl_sparse.vla_policy/1",
     "network": {fields of VLAConfig},
     "tokenizer": {"kind": "words", "words": [...]} or {"kind": "llama", "definition": {content of a tokenizer.json}},
     "source": {fields of VLASource; only where one is known}}

Network weights are fp16, normalisation constants as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import InstructionTokenizer, tokenizer_from_config
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.storage.tensors import check_folder, read_tensors, take, write_tensors

__all__ = ["StoredVLA", "VLASource", "read_vla", "write_vla"]

_NETWORK, _NORMALIZER = "network.", "normalizer."


@dataclass(frozen=True)
class VLASource:
    """What a vision-language-action policy was trained for.

    Attributes:
        task: a task, a suite of LIBERO or a data set, by its name; None where nobody noted it.
        cameras: name of an image here -> its name in the demonstrations; empty where nobody noted them.
        images: ``"rendered"`` at the policy's size, or as ``"openvla_oft"``'s evaluation prepares them, see
            `torchrl_sparse.envs.release_images`.
    """

    task: str | None = None
    cameras: dict[str, str] = field(default_factory=dict)
    images: Literal["rendered", "openvla_oft"] = "rendered"


@dataclass(frozen=True)
class _Config:
    """Content of ``config.json``."""

    format: Literal["torchrl_sparse.vla_policy/1"]
    network: dict[str, Any]
    tokenizer: dict[str, Any]
    source: VLASource | None = None


@dataclass(frozen=True)
class StoredVLA:
    """The parts of a vision-language-action policy that files hold.

    Attributes:
        network: the network, in evaluation mode.
        normalizer: of states and actions.
        tokenizer: of instructions.
        source: what it was trained for.
    """

    network: VLANetwork
    normalizer: QuantileNormalizer
    tokenizer: InstructionTokenizer
    source: VLASource = VLASource()


def write_vla(path: Path, policy: StoredVLA) -> None:
    """Write both files into the folder ``path``, each in one piece or not at all."""
    weights = {name: value.half() for name, value in policy.network.state_dict().items()}
    tensors = _prefixed(_NETWORK, weights) | _prefixed(_NORMALIZER, policy.normalizer.state_dict())
    write_tensors(path / "model.safetensors", tensors)
    network, tokenizer = policy.network.config.to_dict(), policy.tokenizer.to_config()
    source = None if policy.source == VLASource() else policy.source
    config = _Config("torchrl_sparse.vla_policy/1", network, tokenizer, source)
    write_json(path / "config.json", config)


def read_vla(path: Path, expected: VLAConfig | None = None) -> StoredVLA:
    """Read the policy in the folder ``path``, its network in f32.

    Args:
        path: the folder.
        expected: the architecture that it must hold; any by default.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: naming the file, what was expected and what came.
    """
    where = path / "config.json"
    check_folder(path)
    stored = read_json(where, _Config)
    try:
        config = VLAConfig.from_dict(stored.network)
        tokenizer = tokenizer_from_config(stored.tokenizer)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error
    _check_architecture(where, expected, config)
    with torch.device("meta"):  # the configuration is compared with the weights before memory is taken for it
        state = _prefixed(_NETWORK, VLANetwork(config).state_dict())
    identity = QuantileNormalizer.identity(config.state_dim, config.action_dim)
    tensors = read_tensors(path / "model.safetensors", state | _prefixed(_NORMALIZER, identity.state_dict()))
    network = VLANetwork(config)
    network.load_state_dict({name: value.float() for name, value in take(tensors, _NETWORK).items()})
    try:
        normalizer = QuantileNormalizer(**take(tensors, _NORMALIZER))
    except ValueError as error:
        raise ValueError(f"{path / 'model.safetensors'}: normalizer: {error}") from error
    return StoredVLA(network.eval(), normalizer, tokenizer, stored.source or VLASource())


def _check_architecture(path: Path, expected: VLAConfig | None, found: VLAConfig) -> None:
    if expected is None or found == expected:
        return
    want, have = expected.to_dict(), found.to_dict()
    parts = [f"{name}: expected {want[name]}, got {have[name]}" for name in want if want[name] != have[name]]
    raise ValueError(f"{path}: {'; '.join(parts)}")


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: value for name, value in tensors.items()}
