"""Files of a vision-language-action policy: ``config.json`` and ``model.safetensors``. Neither can contain code.

::

    {"format": "torchrl_sparse.vla_policy/1",
     "network": {fields of VLAConfig},
     "tokenizer": {"kind": "words", "words": [...]} or {"kind": "llama", "definition": {content of a tokenizer.json}},
     "source": {fields of VLASource; only where one is known}}

Network weights are fp16, normalisation constants as they are. Of a policy with adapters on a language model, only what was
trained is there; ``"base": {"sha256": ..., "rank": ...}`` tells which file the rest is in, and ``"tokenizer"`` is
``{"kind": "base"}``, the one in that file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.adapters import add_adapters, is_frozen
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import InstructionTokenizer, tokenizer_from_config
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.storage.language_model import LanguageModel, digest_of, load_base, read_language_model
from torchrl_sparse.storage.tensors import check_folder, read_tensors, take, write_tensors

__all__ = ["AdaptedBase", "StoredVLA", "VLASource", "read_vla", "trained_state", "write_vla"]

_NETWORK, _NORMALIZER = "network.", "normalizer."
_BASE_TOKENIZER = {"kind": "base"}


@dataclass(frozen=True)
class VLASource:
    """Task and data for which a vision-language-action policy was trained.

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
class AdaptedBase:
    """Language model that a policy adapts.

    Attributes:
        sha256: of its file.
        rank: of the adapters.
    """

    sha256: str
    rank: int


@dataclass(frozen=True)
class _Config:
    """Content of ``config.json``."""

    format: Literal["torchrl_sparse.vla_policy/1"]
    network: dict[str, Any]
    tokenizer: dict[str, Any]
    source: VLASource | None = None
    base: AdaptedBase | None = None


@dataclass(frozen=True)
class StoredVLA:
    """Parts of a vision-language-action policy that are stored in files.

    Attributes:
        network: the network, in evaluation mode.
        normalizer: of states and actions.
        tokenizer: of instructions.
        source: what it was trained for.
        base: the language model that its adapters are for; None where there are no adapters.
    """

    network: VLANetwork
    normalizer: QuantileNormalizer
    tokenizer: InstructionTokenizer
    source: VLASource = VLASource()
    base: AdaptedBase | None = None


def write_vla(path: Path, policy: StoredVLA) -> None:
    """Write both files into the folder ``path``, each atomically."""
    weights = {name: value.half() for name, value in trained_state(policy.network, policy.base).items()}
    tensors = _prefixed(_NETWORK, weights) | _prefixed(_NORMALIZER, policy.normalizer.state_dict())
    write_tensors(path / "model.safetensors", tensors)
    network = policy.network.config.to_dict()
    tokenizer = policy.tokenizer.to_config() if policy.base is None else _BASE_TOKENIZER
    source = None if policy.source == VLASource() else policy.source
    config = _Config("torchrl_sparse.vla_policy/1", network, tokenizer, source, policy.base)
    write_json(path / "config.json", config)


def read_vla(path: Path, expected: VLAConfig | None = None, base: Path | None = None) -> StoredVLA:
    """Read a policy from the folder ``path``, its network in f32.

    Args:
        path: the folder.
        expected: the architecture that it must hold; any by default.
        base: file of the language model that it adapts, where it does.

    Raises:
        FileNotFoundError: if a file is not there.
        InputError: naming the file, what was expected and what came.
    """
    where = path / "config.json"
    check_folder(path)
    stored = read_json(where, _Config)
    language = _read_base(where, stored.base, base)
    try:
        config = VLAConfig.from_dict(stored.network)
        tokenizer = tokenizer_from_config(stored.tokenizer) if language is None else language.tokenizer
        _check_base(config, language)
        # the configuration is compared with the weights before memory is taken for it
        with torch.device("meta"):
            own = trained_state(_build(config, stored.base), stored.base)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error
    _check_architecture(where, expected, config)
    identity = QuantileNormalizer.identity(config.state_dim, config.action_dim)
    tensors = read_tensors(
        path / "model.safetensors", _prefixed(_NETWORK, own) | _prefixed(_NORMALIZER, identity.state_dict())
    )
    network = _build(config, stored.base)
    weights = {name: value.float() for name, value in take(tensors, _NETWORK).items()}
    network.load_state_dict(weights, strict=language is None)
    if language is not None:
        load_base(network, language)
    try:
        normalizer = QuantileNormalizer(**take(tensors, _NORMALIZER))
    except ValueError as error:
        raise InputError(f"{path / 'model.safetensors'}: normalizer: {error}") from error
    return StoredVLA(network.eval(), normalizer, tokenizer, stored.source or VLASource(), stored.base)


def trained_state(network: VLANetwork, base: AdaptedBase | None) -> dict[str, Tensor]:
    """Return the stored part of a network's state: everything, or all but the language model's weights."""
    state = network.state_dict()
    return state if base is None else {name: value for name, value in state.items() if not is_frozen(name)}


def _read_base(where: Path, stored: AdaptedBase | None, path: Path | None) -> LanguageModel | None:
    if (stored is None) != (path is None):
        needs = "none" if stored is None else f"the file with SHA-256 {stored.sha256}"
        raise InputError(f"{where}: base: expected {needs}, got {path}")
    if stored is None or path is None:
        return None
    if not path.is_file():
        raise FileNotFoundError(f"base: expected a file {path}, got none")
    if (found := digest_of(path)) != stored.sha256:  # before anything else in it is believed
        raise InputError(
            f"{path}: expected the file with SHA-256 {stored.sha256}, which {where} names, got {found}"
        )
    return read_language_model(path)


def _check_base(config: VLAConfig, language: LanguageModel | None) -> None:
    for name, size in ({} if language is None else language.sizes).items():
        if (found := getattr(config, name)) != size:
            raise InputError(f"network.{name}: expected {size}, as in the base, got {found}")


def _build(config: VLAConfig, base: AdaptedBase | None) -> VLANetwork:
    network = VLANetwork(config)
    return network if base is None else add_adapters(network, base.rank)


def _check_architecture(path: Path, expected: VLAConfig | None, found: VLAConfig) -> None:
    if expected is None or found == expected:
        return
    want, have = expected.to_dict(), found.to_dict()
    parts = [f"{name}: expected {want[name]}, got {have[name]}" for name in want if want[name] != have[name]]
    raise InputError(f"{path}: {'; '.join(parts)}")


def _prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: value for name, value in tensors.items()}
