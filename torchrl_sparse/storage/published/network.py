"""The parts of a published checkpoint that both kinds of policy have: denoiser, sampler, entries of the normaliser."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.storage.published.config import PublishedConfig
from torchrl_sparse.storage.published.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.storage.tensors import check_finite, check_shapes, shapes_of, take

__all__ = ["read_affine", "read_network", "read_sampler", "read_tensors"]

_SAMPLERS = {"DDPMScheduler": "ddpm", "DDIMScheduler": "ddim"}
# The settings of diffusers' schedulers that `Sampler` has; each with its default in diffusers.
_SAMPLER_SETTINGS = {
    "beta_schedule": ("linear", "squaredcos_cap_v2"),
    "clip_sample": (True, True),
    "prediction_type": ("epsilon", "epsilon"),
}
_DDPM_SETTINGS = {"variance_type": ("fixed_small", "fixed_small")}
_DDIM_SETTINGS = {"set_alpha_to_one": (True, True), "steps_offset": (0, 0)}


def read_network(
    archive: TorchArchive, config: PublishedConfig, section: str, stored: dict[str, StoredTensor]
) -> TransformerForDiffusion:
    """Make the denoiser, in evaluation mode.

    Args:
        archive: the checkpoint.
        config: its configuration.
        section: where the denoiser's options are: "policy.model" or "policy".
        stored: its tensors by name, without ``model.``.

    Raises:
        ValueError: if tensors are missing, do not fit together or contradict the configuration.
    """
    default = section == "policy"  # what the published image policy assumes, and the denoiser alone does not
    for option in (f"{section}.time_as_cond", f"{section}.obs_as_cond"):
        if not config.get(option, bool, default or option.endswith("time_as_cond")):
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
    with torch.device("meta"):  # everything is compared with the tensors before memory is taken for it
        declared = TransformerForDiffusion(**arguments)
    expected = {"mask": declared.mask, "memory_mask": declared.memory_mask} if masks else {}
    check_shapes("model", shapes_of(masks), shapes_of(expected))
    check_shapes("model", shapes_of(stored), shapes_of(declared.state_dict()))
    _check_options(config, section, declared)
    tensors = read_tensors(archive, "model", stored)
    network = TransformerForDiffusion(**arguments)
    for name, value in masks.items():
        if not torch.equal(archive.tensor(value), network.get_buffer(name)):
            raise ValueError(f"model.{name}: expected the causal mask, got another")
    network.load_state_dict(tensors)
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


def _check_options(config: PublishedConfig, section: str, network: TransformerForDiffusion) -> None:
    """Compare what the tensors tell with what the configuration says."""
    said = {
        f"{section}.causal_attn": (
            config.get(f"{section}.causal_attn", bool, section == "policy"),
            network.causal_attn,
        ),
        "n_obs_steps": (config.get("n_obs_steps", int), network.n_obs_steps),
        "horizon": (config.get("horizon", int), network.horizon),
    }
    for name, (configured, found) in said.items():
        if configured != found:
            raise ValueError(f"cfg: {name} is {configured}, the tensors say {found}")


def read_sampler(config: PublishedConfig) -> Sampler:
    """Make the sampler.

    Raises:
        ValueError: if it has settings that `Sampler` has not.
    """
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
    try:
        return Sampler(kind, config.get("policy.num_inference_steps", int, train_steps), train_steps)
    except ValueError as error:
        raise ValueError(f"cfg: {section}: {error}") from error


def read_affine(
    archive: TorchArchive, stored: dict[str, StoredTensor], name: str, size: int
) -> tuple[Tensor, Tensor]:
    """Scale and offset, f32 [size], of one entry of the normaliser; takes it out of ``stored``.

    Raises:
        ValueError: if the entry is missing or of another size.
    """
    entry = {k: v for k, v in take(stored, f"{name}.").items() if not k.startswith("input_stats.")}
    single = "scale" in entry and entry["scale"].shape == (1,)  # one number for all dimensions
    expected = dict.fromkeys(("scale", "offset"), (1,) if single else (size,))
    check_shapes(f"normalizer: {name}", shapes_of(entry), expected)
    tensors = read_tensors(archive, f"normalizer: {name}", entry)
    return tensors["scale"].expand(size).clone(), tensors["offset"].expand(size).clone()


def read_tensors(archive: TorchArchive, where: str, stored: Mapping[str, StoredTensor]) -> dict[str, Tensor]:
    """Read tensors as f32, checked to be finite."""
    tensors = {}
    for name, value in stored.items():
        if not value.storage.dtype.is_floating_point:
            raise ValueError(f"{where}: {name}: expected floating-point numbers, got {value.storage.dtype}")
        tensors[name] = archive.tensor(value).float()
    check_finite(where, tensors)
    return tensors
