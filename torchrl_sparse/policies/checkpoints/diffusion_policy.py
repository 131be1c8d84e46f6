"""Checkpoints of the published Diffusion Policy code (arXiv:2303.04137), transformer policies.

A checkpoint is ``torch.save`` of ``{"cfg": OmegaConf, "state_dicts": {"model", "ema_model", "optimizer"},
"pickles": {name: pickled bytes}}``, pickled by dill. Here all of it is data: nothing in it is executed, no
expression of the configuration is evaluated, and only the tensors that are needed are read. Sizes follow from
the tensors; the configuration gives what they cannot tell (heads, sampler, layout of the observations).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.data.normalize import Normalizer
from torchrl_sparse.policies.checkpoints.inert_pickle import read_pickle
from torchrl_sparse.policies.checkpoints.pretrained import StoredPolicy
from torchrl_sparse.policies.checkpoints.published_config import KNOWN_NAMES, PublishedConfig
from torchrl_sparse.policies.checkpoints.tensors import check_finite, check_shapes, take
from torchrl_sparse.policies.checkpoints.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion

__all__ = ["CheckpointError", "read_diffusion_policy"]

_LOW_DIM = "DiffusionTransformerLowdimPolicy"
_SAMPLERS = {"DDPMScheduler": "ddpm", "DDIMScheduler": "ddim"}
# The settings of diffusers' schedulers that `NoiseSchedule` has; each with its default in diffusers.
_SAMPLER_SETTINGS = {
    "beta_schedule": ("linear", "squaredcos_cap_v2"),
    "clip_sample": (True, True),
    "prediction_type": ("epsilon", "epsilon"),
}
_DDPM_SETTINGS = {"variance_type": ("fixed_small", "fixed_small")}
_MAX_STEPS = 10_000
_DDIM_SETTINGS = {"set_alpha_to_one": (True, True), "steps_offset": (0, 0)}


class CheckpointError(ValueError):
    """A file is no checkpoint that can be read; the message names the file, what was expected and what came."""


def read_diffusion_policy(path: str | Path) -> StoredPolicy:
    """Reads a checkpoint of ``DiffusionTransformerLowdimPolicy``.

    Raises:
        FileNotFoundError: if there is no file.
        CheckpointError: if it is damaged, asks for anything but data, or holds another kind of policy.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"checkpoint: expected a file {path}")
    try:
        with TorchArchive(path) as archive:
            return _read(archive)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error


def _read(archive: TorchArchive) -> StoredPolicy:
    payload = _mapping("payload", archive.contents(KNOWN_NAMES))
    config = PublishedConfig(payload.get("cfg"))
    kind = config.get("policy._target_", str).rpartition(".")[2]
    if kind != _LOW_DIM:
        raise ValueError(f"cfg: policy._target_: expected {_LOW_DIM}, got {kind}")
    weights, tensors = _weights(config, payload)
    counters = {
        name: read_pickle(data)
        for name, data in _mapping("pickles", payload.get("pickles", {})).items()
        if isinstance(data, bytes)
    }
    network = _read_network(archive, config, "policy.model", take(tensors, "model."))
    normalizer = _read_normalizer(archive, take(tensors, "normalizer.params_dict."), network)
    _nothing_left(tensors)
    source = {
        "weights": weights,
        "task": config.get("task.name", str, None),
        "epoch": counters.get("epoch"),
        "n_action_steps": config.get("n_action_steps", int),
        "state_keys": config.get("task.obs_keys", list, None),
    }
    return StoredPolicy(network, normalizer, _sampler(config), source)


def _weights(config: PublishedConfig, payload: Mapping) -> tuple[str, dict[str, StoredTensor]]:
    """The state dict to use, by preference the averaged one, and what it is called."""
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


def _read_network(
    archive: TorchArchive, config: PublishedConfig, section: str, stored: dict[str, StoredTensor]
) -> TransformerForDiffusion:
    """The denoiser from tensors named without ``model.``; ``section`` of the configuration has its options."""
    for option in (f"{section}.time_as_cond", f"{section}.obs_as_cond"):
        if not config.get(option, bool, option.endswith("time_as_cond")):
            raise ValueError(f"cfg: {option}: expected true, got false")
    if config.get("policy.pred_action_steps_only", bool, False):
        raise ValueError("cfg: policy.pred_action_steps_only: expected false, got true")
    masks = {name: stored.pop(name) for name in ("mask", "memory_mask") if name in stored}
    arguments = {
        **_sizes(stored),
        "n_head": config.get(f"{section}.n_head", int),
        "p_drop_emb": config.get(f"{section}.p_drop_emb", float, 0.0),
        "p_drop_attn": config.get(f"{section}.p_drop_attn", float, 0.0),
        "causal_attn": bool(masks),
    }
    with torch.device("meta"):  # sizes are checked before memory is taken for them
        shapes = {k: tuple(v.shape) for k, v in TransformerForDiffusion(**arguments).state_dict().items()}
    check_shapes("model", stored, shapes)
    network = TransformerForDiffusion(**arguments)
    _check_options(archive, config, section, network, masks)
    network.load_state_dict(read_tensors(archive, "model", stored))
    return network.eval()


def _sizes(stored: Mapping[str, StoredTensor]) -> dict[str, int]:
    def size(name: str, axis: int) -> int:
        if name not in stored or len(stored[name].shape) <= axis:
            raise ValueError(
                f"model: expected a tensor {name} with {axis + 1} axes, got {_describe(stored, name)}"
            )
        return stored[name].shape[axis]

    def layers(of: str) -> int:
        found = (re.match(rf"{of}\.layers\.(\d+)\.", name) for name in stored)
        return len({match.group(1) for match in found if match})

    return {
        "input_dim": size("input_emb.weight", 1),
        "output_dim": size("head.weight", 0),
        "horizon": size("pos_emb", 1),
        "n_obs_steps": size("cond_pos_emb", 1) - 1,
        "cond_dim": size("cond_obs_emb.weight", 1),
        "n_layer": layers("decoder"),
        "n_emb": size("pos_emb", 2),
        "n_cond_layers": layers("encoder"),
    }


def _describe(stored: Mapping[str, StoredTensor], name: str) -> str:
    return f"shape {stored[name].shape}" if name in stored else "none"


def _check_options(archive, config, section: str, network: TransformerForDiffusion, masks: Mapping) -> None:
    """Compares what the tensors tell with what the configuration says."""
    said = {
        f"{section}.causal_attn": (config.get(f"{section}.causal_attn", bool, False), network.causal_attn),
        "n_obs_steps": (config.get("n_obs_steps", int), network.n_obs_steps),
        "horizon": (config.get("horizon", int), network.horizon),
    }
    for name, (configured, found) in said.items():
        if configured != found:
            raise ValueError(f"cfg: {name} is {configured}, the tensors say {found}")
    expected = {"mask": network.mask, "memory_mask": network.memory_mask} if masks else {}
    check_shapes("model", masks, {name: tuple(value.shape) for name, value in expected.items()})
    for name, value in expected.items():
        if not torch.equal(archive.tensor(masks[name]), value):
            raise ValueError(f"model.{name}: expected the causal mask, got another")


def _read_normalizer(
    archive, stored: dict[str, StoredTensor], network: TransformerForDiffusion
) -> Normalizer:
    pairs = {}
    for name, field, size in (("obs", "state", network.cond_dim), ("action", "action", network.input_dim)):
        pairs |= read_affine(archive, stored, name, field, size)
    _nothing_left(stored)
    return Normalizer(**pairs)


def read_affine(
    archive: TorchArchive, stored: dict[str, StoredTensor], name: str, field: str, size: int
) -> dict[str, Tensor]:
    """Scale and offset [size] of one entry of the normaliser, as ``<field>_scale`` and ``<field>_offset``."""
    entry = {
        key: value for key, value in take(stored, f"{name}.").items() if not key.startswith("input_stats.")
    }
    single = "scale" in entry and entry["scale"].shape == (1,)  # one number for all dimensions
    check_shapes(
        f"normalizer: {name}", entry, dict.fromkeys(("scale", "offset"), (1,) if single else (size,))
    )
    tensors = read_tensors(archive, f"normalizer: {name}", entry)
    return {f"{field}_{part}": value.expand(size).clone() for part, value in tensors.items()}


def read_tensors(archive: TorchArchive, where: str, stored: Mapping[str, StoredTensor]) -> dict[str, Tensor]:
    """Reads tensors as f32, checked to be finite."""
    tensors = {}
    for name, value in stored.items():
        if not value.storage.dtype.is_floating_point:
            raise ValueError(f"{where}: {name}: expected floating-point numbers, got {value.storage.dtype}")
        tensors[name] = archive.tensor(value).float()
    check_finite(where, tensors)
    return tensors


def _sampler(config: PublishedConfig) -> NoiseSchedule:
    section = "policy.noise_scheduler"
    name = config.get(f"{section}._target_", str).rpartition(".")[2]
    if name not in _SAMPLERS:
        raise ValueError(f"cfg: {section}._target_: expected one of {sorted(_SAMPLERS)}, got {name}")
    kind = _SAMPLERS[name]
    for option, (default, supported) in (
        _SAMPLER_SETTINGS | (_DDPM_SETTINGS if kind == "ddpm" else _DDIM_SETTINGS)
    ).items():
        found = config.get(f"{section}.{option}", type(supported), default)
        if found != supported:
            raise ValueError(f"cfg: {section}.{option}: expected {supported!r}, got {found!r}")
    train_steps = config.get(f"{section}.num_train_timesteps", int)
    if train_steps > _MAX_STEPS:
        raise ValueError(
            f"cfg: {section}.num_train_timesteps: expected at most {_MAX_STEPS}, got {train_steps}"
        )
    return NoiseSchedule(kind, config.get("policy.num_inference_steps", int, train_steps), train_steps)


def _mapping(where: str, value: Any) -> Mapping:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected a dict, got {type(value).__name__}")
    return value


def _nothing_left(tensors: Mapping[str, StoredTensor]) -> None:
    if tensors:
        raise ValueError(f"expected no further tensors, got {sorted(tensors)[:5]}")
