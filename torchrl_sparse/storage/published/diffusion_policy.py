"""Reader of transformer checkpoints of the published Diffusion Policy code (arXiv:2303.04137).

A checkpoint is ``torch.save`` of ``{"cfg": OmegaConf, "state_dicts": {"model", "ema_model", "optimizer"},
"pickles": {name: pickled bytes}}``, pickled by dill. Here all of it is data: nothing in it is executed, no
expression of the configuration is evaluated, and only the tensors that are needed are read. Sizes follow from
the tensors; the configuration gives what they cannot tell (heads, sampler, layout of the observations).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.storage.diffusion import StoredPolicy
from torchrl_sparse.storage.published.config import KNOWN_NAMES, PublishedConfig
from torchrl_sparse.storage.published.entries import check_policy_entries, check_task_entries
from torchrl_sparse.storage.published.faults import naming_faults
from torchrl_sparse.storage.published.inert_pickle import read_pickle
from torchrl_sparse.storage.published.network import read_affine, read_network
from torchrl_sparse.storage.published.scheduler import read_sampler
from torchrl_sparse.storage.published.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.storage.published.vision import ImageLayout, read_vision
from torchrl_sparse.storage.published.wrappers import without_wrappers
from torchrl_sparse.storage.tensors import take

__all__ = ["read_diffusion_policy"]

_Parts = tuple[TransformerForDiffusion, Normalizer, VisionEncoder | None]


def read_diffusion_policy(path: str | Path, ignore: Collection[str] = ()) -> StoredPolicy:
    """Read a checkpoint of ``DiffusionTransformerLowdimPolicy`` or ``DiffusionTransformerHybridImagePolicy``.

    Args:
        path: the file.
        ignore: paths of entries, such as ``"task.dataset.note"``, that the policy does not depend on and that
            `torchrl_sparse.storage.published.entries` does not know.

    Raises:
        FileNotFoundError: if there is no file.
        CheckpointError: if it is damaged, asks for anything but data, holds another kind of policy, or was trained or used
            in a way that is not supported or, by an entry of its configuration, not known.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, got no file")
    with naming_faults(path), TorchArchive(path) as archive:
        return _read(archive, frozenset(ignore))


def _read(archive: TorchArchive, ignore: frozenset[str]) -> StoredPolicy:
    payload = _mapping("payload", archive.contents(KNOWN_NAMES))
    config = PublishedConfig(payload.get("cfg"))
    kind = config.get("policy._target_", str).rpartition(".")[2]
    if kind not in _READERS:
        raise InputError(f"cfg: policy._target_: expected one of {sorted(_READERS)}, got {kind}")
    check_policy_entries(config, cameras=kind == _IMAGES, ignore=ignore)
    state_keys, abs_action = check_task_entries(config, ignore)
    weights, tensors = _weights(config, payload)
    source = {
        "weights": weights,
        "task": config.get("task.name", str, None),
        "epoch": _epoch(payload),
        "n_action_steps": _executed_steps(config),
        "abs_action": abs_action,
        "robosuite": _noted(config, payload, "env_version", str),
    }
    source["state_keys"] = state_keys
    if (rate := _noted(config, payload, "env_kwargs.control_freq", float)) is not None:
        source["control_freq"] = rate
    sampler = read_sampler(config, ignore)
    network, normalizer, vision = _READERS[kind](archive, config, tensors, source)
    _nothing_left(tensors)
    return StoredPolicy(network, normalizer, sampler, vision, source)


def _read_low_dim(
    archive: TorchArchive, config: PublishedConfig, tensors: dict[str, StoredTensor], _: dict[str, Any]
) -> _Parts:
    target = config.get("policy.model._target_", str)
    if target.rpartition(".")[2] != "TransformerForDiffusion":
        raise InputError(f"cfg: policy.model._target_: expected TransformerForDiffusion, got {target}")
    network = read_network(archive, config, "policy.model", take(tensors, "model."))
    entries = take(tensors, "normalizer.params_dict.")
    normalizer = Normalizer(
        *read_affine(archive, entries, "obs", network.cond_dim),
        *read_affine(archive, entries, "action", network.input_dim),
    )
    _nothing_left(entries)
    return network, normalizer, None


def _read_images(
    archive: TorchArchive, config: PublishedConfig, tensors: dict[str, StoredTensor], source: dict[str, Any]
) -> _Parts:
    layout = ImageLayout.of(config)
    network = read_network(archive, config, "policy", take(tensors, "model."))
    vision = read_vision(archive, config, layout, take(tensors, "obs_encoder.obs_nets."))
    if layout.features != network.cond_dim:
        raise InputError(
            f"cfg: shape_meta has {layout.features} features, the tensors say {network.cond_dim}"
        )
    with torch.no_grad():
        network.cond_obs_emb.weight.copy_(network.cond_obs_emb.weight[:, layout.columns()])
    entries = take(tensors, "normalizer.params_dict.")
    for key in layout.cameras.values():
        scale, offset = read_affine(archive, entries, key, 1)
        if (scale.item(), offset.item()) != (2.0, -1.0):
            raise InputError(
                f"normalizer: {key}: expected scale 2, offset -1, got {scale.item()}, {offset.item()}"
            )
    states = [read_affine(archive, entries, key, size) for key, size in layout.states.items()]
    scale, offset = (torch.cat(part) for part in zip(*states, strict=True))
    normalizer = Normalizer(scale, offset, *read_affine(archive, entries, "action", network.input_dim))
    _nothing_left(entries)
    source |= {"state_keys": list(layout.states), "cameras": layout.cameras}
    return network, normalizer, vision


_LOW_DIM, _IMAGES = "DiffusionTransformerLowdimPolicy", "DiffusionTransformerHybridImagePolicy"
_READERS = {_LOW_DIM: _read_low_dim, _IMAGES: _read_images}


def _executed_steps(config: PublishedConfig) -> int:
    """Return how many actions of a chunk are executed."""
    steps = config.get("n_action_steps", int)
    for place in ("policy.n_action_steps", "task.env_runner.n_action_steps"):
        if (said := config.literal(place, int)) not in (None, steps):
            raise InputError(f"cfg: {place}: expected {steps}, as n_action_steps, got {said}")
    return steps


def _noted(config: PublishedConfig, payload: Mapping, name: str, kind: type) -> Any:
    """Return what robomimic's ``env_meta`` notes under a name; None where a checkpoint has none."""
    if "env_meta" in payload:
        noted = PublishedConfig({"env_meta": payload["env_meta"]})  # tensors stand beside it
        return noted.get(f"env_meta.{name}", kind, None)
    places = (f"{place}env_meta.{name}" for place in ("", "task.", "task.env_runner."))
    return next((found for place in places if (found := config.get(place, kind, None)) is not None), None)


def _epoch(payload: Mapping) -> int | None:
    """Return the epoch of the weights, which has a pickle of its own; None if there is none."""
    data = _mapping("pickles", payload.get("pickles", {})).get("epoch")
    epoch = read_pickle(data) if isinstance(data, bytes) else data
    if epoch is not None and type(epoch) is not int:
        raise InputError(f"pickles: epoch: expected a whole number, got {type(epoch).__name__}")
    return epoch


def _weights(config: PublishedConfig, payload: Mapping) -> tuple[str, dict[str, StoredTensor]]:
    """Return what the state dict to use is called, and it: what ``use_ema`` says, else the averaged one if there is one."""
    states = _mapping("state_dicts", payload.get("state_dicts"))
    averaged = config.get("training.use_ema", bool, "ema_model" in states)
    name = "ema_model" if averaged else "model"
    if name not in states:
        raise InputError(
            f"state_dicts: expected {name}, since cfg.training.use_ema is {str(averaged).lower()}, got {sorted(states)}"
        )
    tensors = dict(_mapping(f"state_dicts: {name}", states[name]))
    for key, value in tensors.items():
        if not isinstance(key, str) or not isinstance(value, StoredTensor):
            raise InputError(f"state_dicts: {name}: {key}: expected a tensor, got {type(value).__name__}")
    tensors = {key: value for key, value in tensors.items() if not key.endswith("_dummy_variable")}
    return name, without_wrappers(f"state_dicts: {name}", tensors)


def _mapping(where: str, value: Any) -> Mapping:
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a dict, got {type(value).__name__}")
    return value


def _nothing_left(tensors: Mapping[str, StoredTensor]) -> None:
    if tensors:
        raise InputError(f"expected no further tensors, got {sorted(tensors)[:5]}")
