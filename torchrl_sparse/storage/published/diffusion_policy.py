"""Checkpoints of the published Diffusion Policy code (arXiv:2303.04137), transformer policies.

A checkpoint is ``torch.save`` of ``{"cfg": OmegaConf, "state_dicts": {"model", "ema_model", "optimizer"},
"pickles": {name: pickled bytes}}``, pickled by dill. Here all of it is data: nothing in it is executed, no
expression of the configuration is evaluated, and only the tensors that are needed are read. Sizes follow from
the tensors; the configuration gives what they cannot tell (heads, sampler, layout of the observations).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.storage.diffusion import StoredPolicy
from torchrl_sparse.storage.published.config import KNOWN_NAMES, PublishedConfig
from torchrl_sparse.storage.published.faults import naming_faults
from torchrl_sparse.storage.published.inert_pickle import read_pickle
from torchrl_sparse.storage.published.network import read_affine, read_network, read_sampler
from torchrl_sparse.storage.published.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.storage.published.vision import ImageLayout, read_vision
from torchrl_sparse.storage.tensors import take

__all__ = ["read_diffusion_policy"]


def read_diffusion_policy(path: str | Path) -> StoredPolicy:
    """Read a checkpoint of ``DiffusionTransformerLowdimPolicy`` or ``DiffusionTransformerHybridImagePolicy``.

    Raises:
        FileNotFoundError: if there is no file.
        CheckpointError: if it is damaged, asks for anything but data, or holds another kind of policy.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, got no file")
    with naming_faults(path), TorchArchive(path) as archive:
        return _read(archive)


def _read(archive: TorchArchive) -> StoredPolicy:
    payload = _mapping("payload", archive.contents(KNOWN_NAMES))
    config = PublishedConfig(payload.get("cfg"))
    kind = config.get("policy._target_", str).rpartition(".")[2]
    if kind not in _READERS:
        raise ValueError(f"cfg: policy._target_: expected one of {sorted(_READERS)}, got {kind}")
    weights, tensors = _weights(config, payload)
    source = {
        "weights": weights,
        "task": config.get("task.name", str, None),
        "epoch": _epoch(payload),
        "n_action_steps": config.get("n_action_steps", int),
        "robosuite": _robosuite_version(config, payload),
    }
    policy = _READERS[kind](archive, config, tensors, source)
    _nothing_left(tensors)
    return policy


def _read_low_dim(
    archive: TorchArchive, config: PublishedConfig, tensors: dict[str, StoredTensor], source: dict[str, Any]
) -> StoredPolicy:
    network = read_network(archive, config, "policy.model", take(tensors, "model."))
    entries = take(tensors, "normalizer.params_dict.")
    normalizer = Normalizer(
        *read_affine(archive, entries, "obs", network.cond_dim),
        *read_affine(archive, entries, "action", network.input_dim),
    )
    _nothing_left(entries)
    source["state_keys"] = config.names("task.obs_keys")
    return StoredPolicy(network, normalizer, read_sampler(config), source=source)


def _read_images(
    archive: TorchArchive, config: PublishedConfig, tensors: dict[str, StoredTensor], source: dict[str, Any]
) -> StoredPolicy:
    layout = ImageLayout.of(config)
    network = read_network(archive, config, "policy", take(tensors, "model."))
    vision = read_vision(archive, config, layout, take(tensors, "obs_encoder.obs_nets."))
    if layout.features != network.cond_dim:
        raise ValueError(
            f"cfg: shape_meta has {layout.features} features, the tensors say {network.cond_dim}"
        )
    with torch.no_grad():
        network.cond_obs_emb.weight.copy_(network.cond_obs_emb.weight[:, layout.columns()])
    entries = take(tensors, "normalizer.params_dict.")
    for key in layout.cameras.values():
        scale, offset = read_affine(archive, entries, key, 1)
        if (scale.item(), offset.item()) != (2.0, -1.0):
            raise ValueError(
                f"normalizer: {key}: expected scale 2, offset -1, got {scale.item()}, {offset.item()}"
            )
    states = [read_affine(archive, entries, key, size) for key, size in layout.states.items()]
    normalizer = Normalizer(
        *(torch.cat(part) for part in zip(*states, strict=True)),
        *read_affine(archive, entries, "action", network.input_dim),
    )
    _nothing_left(entries)
    source |= {"state_keys": list(layout.states), "cameras": layout.cameras}
    return StoredPolicy(network, normalizer, read_sampler(config), vision, source)


_READERS = {
    "DiffusionTransformerLowdimPolicy": _read_low_dim,
    "DiffusionTransformerHybridImagePolicy": _read_images,
}


def _robosuite_version(config: PublishedConfig, payload: Mapping) -> str | None:
    """Return the version that robomimic's ``env_meta`` notes; None where a checkpoint has none."""
    if "env_meta" in payload:
        noted = PublishedConfig({"env_meta": payload["env_meta"]})  # tensors stand beside it
        return noted.get("env_meta.env_version", str, None)
    places = (f"{place}env_meta.env_version" for place in ("", "task.", "task.env_runner."))
    return next(filter(None, (config.get(place, str, None) for place in places)), None)


def _epoch(payload: Mapping) -> int | None:
    """Return the epoch of the weights, which has a pickle of its own; None if there is none."""
    data = _mapping("pickles", payload.get("pickles", {})).get("epoch")
    epoch = read_pickle(data) if isinstance(data, bytes) else data
    if epoch is not None and type(epoch) is not int:
        raise ValueError(f"pickles: epoch: expected a whole number, got {type(epoch).__name__}")
    return epoch


def _weights(config: PublishedConfig, payload: Mapping) -> tuple[str, dict[str, StoredTensor]]:
    """Return the state dict to use, by preference the averaged one, and what it is called."""
    states = _mapping("state_dicts", payload.get("state_dicts"))
    averaged = "ema_model" in states
    if not averaged and config.get("training.use_ema", bool, False):
        raise ValueError("state_dicts: expected ema_model, since cfg.training.use_ema is true, got none")
    name = "ema_model" if averaged else "model"
    tensors = dict(_mapping(f"state_dicts: {name}", states.get(name)))
    for key, value in tensors.items():
        if not isinstance(key, str) or not isinstance(value, StoredTensor):
            raise ValueError(f"state_dicts: {name}: {key}: expected a tensor, got {type(value).__name__}")
    return name, {key: value for key, value in tensors.items() if not key.endswith("_dummy_variable")}


def _mapping(where: str, value: Any) -> Mapping:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected a dict, got {type(value).__name__}")
    return value


def _nothing_left(tensors: Mapping[str, StoredTensor]) -> None:
    if tensors:
        raise ValueError(f"expected no further tensors, got {sorted(tensors)[:5]}")
