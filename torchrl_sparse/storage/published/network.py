"""Parts common to all published checkpoints: denoiser and normaliser entries."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.storage.published.config import PublishedConfig
from torchrl_sparse.storage.published.entries import check_sizes
from torchrl_sparse.storage.published.torch_archive import StoredTensor, TorchArchive
from torchrl_sparse.storage.tensors import check_finite, check_shapes, shapes_of, take

__all__ = ["read_affine", "read_network", "read_tensors"]


def read_network(
    archive: TorchArchive, config: PublishedConfig, section: str, stored: dict[str, StoredTensor]
) -> TransformerForDiffusion:
    """Build the denoiser, in evaluation mode.

    Args:
        archive: the checkpoint.
        config: its configuration.
        section: where the denoiser's options are: "policy.model" or "policy".
        stored: its tensors by name, without ``model.``.

    Raises:
        InputError: if tensors are missing, do not fit together or contradict the configuration.
    """
    cameras = section == "policy"
    # What the published image policy takes where nothing is said, and what the denoiser alone does.
    heads, causal, dropout = (4, True, (0.0, 0.3)) if cameras else (12, False, (0.1, 0.1))
    masks: dict[str, StoredTensor] = {
        name: stored.pop(name) for name in ("mask", "memory_mask") if name in stored
    }
    arguments = {
        **_sizes(stored),
        "n_head": config.get(f"{section}.n_head", int, heads),
        "p_drop_emb": config.get(f"{section}.p_drop_emb", float, dropout[0]),
        "p_drop_attn": config.get(f"{section}.p_drop_attn", float, dropout[1]),
        "causal_attn": bool(masks),
    }
    with torch.device("meta"):  # everything is compared with the tensors before memory is taken for it
        declared = TransformerForDiffusion(**arguments)
    expected = {"mask": declared.mask, "memory_mask": declared.memory_mask} if masks else {}
    check_shapes("model", shapes_of(masks), shapes_of(expected))
    check_shapes("model", shapes_of(stored), shapes_of(declared.state_dict()))
    check_sizes(config, section, declared, cameras=cameras)
    if (said := config.get(f"{section}.causal_attn", bool, causal)) != declared.causal_attn:
        raise InputError(f"cfg: {section}.causal_attn is {said}, the tensors say {declared.causal_attn}")
    tensors = read_tensors(archive, "model", stored)
    network = TransformerForDiffusion(**arguments)
    for name, value in masks.items():
        if not torch.equal(archive.tensor(value), network.get_buffer(name)):
            raise InputError(f"model.{name}: expected the causal mask, got another")
    network.load_state_dict(tensors)
    return network.eval()


def _sizes(stored: Mapping[str, StoredTensor]) -> dict[str, int]:
    def size(name: str, axis: int) -> int:
        if name not in stored or len(stored[name].shape) <= axis:
            raise InputError(
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


def read_affine(
    archive: TorchArchive, stored: dict[str, StoredTensor], name: str, size: int
) -> tuple[Tensor, Tensor]:
    """Return scale and offset, f32 [size], of one normaliser entry, and remove it from ``stored``.

    Raises:
        InputError: if the entry is missing or of another size.
    """
    entry = {k: v for k, v in take(stored, f"{name}.").items() if not k.startswith("input_stats.")}
    single = "scale" in entry and entry["scale"].shape == (1,)  # one number for all dimensions
    expected = dict.fromkeys(("scale", "offset"), (1,) if single else (size,))
    check_shapes(f"normalizer: {name}", shapes_of(entry), expected)
    tensors = read_tensors(archive, f"normalizer: {name}", entry)
    return tensors["scale"].expand(size).clone(), tensors["offset"].expand(size).clone()


def read_tensors(archive: TorchArchive, where: str, stored: Mapping[str, StoredTensor]) -> dict[str, Tensor]:
    """Read tensors as f32 and check that they are finite."""
    tensors = {}
    for name, value in stored.items():
        if not value.storage.dtype.is_floating_point:
            raise InputError(f"{where}: {name}: expected floating-point numbers, got {value.storage.dtype}")
        tensors[name] = archive.tensor(value).float()
    check_finite(where, tensors)
    return tensors
