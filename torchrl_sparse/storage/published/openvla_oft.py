"""Reader of published OpenVLA-OFT checkpoints (arXiv:2502.19645), folders as on the Hugging Face hub, to a `StoredVLA`.

Read are ``config.json``, the safetensors shards, ``action_head--*_checkpoint.pt`` and ``proprio_projector--*_checkpoint.pt``
(tensors only), ``dataset_statistics.json`` and ``tokenizer.json``. The Python files in such a folder are neither imported nor
read.

The towers carry timm's names there (``featurizer`` is DINOv2, ``fused_featurizer`` SigLIP), with LayerScale's ``gamma`` renamed
to ``scale_factor``, and the two ``.pt`` files the prefix ``module.``. The towers' last blocks and final norms, SigLIP's pooling
head and the vocabulary projection take no part in OpenVLA-OFT and are left out.

A folder does not say how many actions a chunk has, which statistics normalise, or whether images are cropped; those are
arguments. It has to be a policy for LIBERO's arm: position, axis-angle and both fingers observed, and seven numbers of an
action, whose last is the gripper. Sizes of other arms, FiLM, diffusion heads and discrete actions are refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.sizes import check_size
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import make_network, network_of
from torchrl_sparse.networks.vla.text import LlamaTokenizer
from torchrl_sparse.storage.json import read_json
from torchrl_sparse.storage.published.faults import naming_faults
from torchrl_sparse.storage.published.openvla_statistics import (
    ACTION_DIM,
    STATE_DIM,
    Normalization,
    read_normalizer,
)
from torchrl_sparse.storage.published.torch_archive import TorchArchive
from torchrl_sparse.storage.published.wrappers import without_wrappers
from torchrl_sparse.storage.tensors import check_finite, check_shapes, read_tensors, shapes_of, take
from torchrl_sparse.storage.vla import StoredVLA, VLASource

__all__ = ["Unsaid", "is_openvla_oft", "read_openvla_oft"]

_DINO, _SIGLIP = "vision_backbone.featurizer.", "vision_backbone.fused_featurizer."
_LLM, _HEAD, _PROPRIO = "language_model.model.", "action_head.", "proprio_projector."
_EMBEDDING = "decoder.llama.embed_tokens.weight"
_FIXED: dict[str, Any] = {
    "image_resize_strategy": "resize-naive",
    "arch_specifier": "no-align+fused-gelu-mlp",
}
_FIXED |= {"use_fused_vision_backbone": True, "timm_override_act_layers": [None, None]}
_FIXED_TEXT = {"rms_norm_eps": 1e-6, "rope_theta": 10000.0, "rope_scaling": None, "hidden_act": "silu"}
_DIFFUSION = "expected a head for L1 regression, got a diffusion head, which is not supported"

_DINO_NAMES = {
    "cls_token": "embeddings.cls_token",
    "reg_token": "embeddings.register_tokens",
    "patch_embed.proj": "embeddings.patch_embeddings.projection",
    "blocks": "encoder.layer",
    "attn.proj": "attention.o_proj",
    "attn.qkv": "attention.qkv",
    "ls1.scale_factor": "layer_scale1.lambda1",
    "ls2.scale_factor": "layer_scale2.lambda1",
}
_SIGLIP_NAMES = {
    "patch_embed.proj": "embeddings.patch_embedding",
    "blocks": "encoder.layers",
    "attn.proj": "self_attn.out_proj",
    "attn.qkv": "self_attn.qkv",
    "norm1": "layer_norm1",
    "norm2": "layer_norm2",
}
_HEAD_NAMES = {"mlp_resnet_blocks": "blocks", ".ffn.": ".", "model.": ""}


def is_openvla_oft(path: str | Path) -> bool:
    """Tell by ``config.json`` whether a folder has the published layout; other files are not checked.

    >>> is_openvla_oft("assets/vla")
    False
    """
    config = Path(path) / "config.json"
    return config.is_file() and read_json(config, dict[str, Any]).get("model_type") == "openvla"


@dataclass(frozen=True)
class Unsaid:
    """Settings that a published folder does not contain; see `VLAPolicy.from_openvla_oft`.

    Raises:
        InputError: if there are not one or two cameras, or no three numbers of heads.
    """

    cameras: int
    heads: Sequence[int]
    chunk_size: int
    normalization: Normalization
    center_crop: bool

    def __post_init__(self) -> None:
        check_size("cameras", self.cameras, len(VLAConfig().cameras))
        if len(self.heads) != 3:
            raise InputError(f"heads: expected those of DINOv2, SigLIP and the decoder, got {self.heads!r}")


def read_openvla_oft(
    path: Path, *, unnorm_key: str | None, unsaid: Unsaid, dtype: torch.dtype | None
) -> StoredVLA:
    """Read a policy from the folder ``path``; see `VLAPolicy.from_openvla_oft`.

    Raises:
        FileNotFoundError: if a file is not there.
        CheckpointError: naming the file, what was expected in it and what was found.
    """
    with naming_faults(path):
        return _read(path, unnorm_key, unsaid, dtype)


def _read(path: Path, unnorm_key: str | None, unsaid: Unsaid, dtype: torch.dtype | None) -> StoredVLA:
    if list(path.glob("vision_backbone*checkpoint*")):
        raise InputError(f"{path}: expected a checkpoint without FiLM, got vision_backbone*checkpoint* files")
    if list(path.glob("noisy_action_projector*checkpoint*")):
        raise InputError(f"{path}: {_DIFFUSION}: noisy_action_projector*checkpoint*")
    image_size = _image_size(path / "config.json", unsaid.heads[2])
    tensors = _read_shards(path) | _read_part(path, _HEAD) | _read_part(path, _PROPRIO)
    if any(name.startswith(f"{_HEAD}noise_predictor.") for name in tensors):
        raise InputError(f"{path}: {_DIFFUSION}: {_HEAD}noise_predictor")
    config = _config(path, tensors, image_size, unsaid)
    statistics = path / "dataset_statistics.json"
    data_set, normalizer = read_normalizer(statistics, unnorm_key, unsaid.normalization)
    weights = _rename(tensors, config)
    expected = make_network(config, device="meta").state_dict()  # compared before memory is taken for it
    check_shapes(str(path), shapes_of(weights), shapes_of(expected))
    check_finite(str(path), weights)
    dtype = weights[_EMBEDDING].dtype if dtype is None else dtype
    network = network_of(config, {name: value.to(dtype) for name, value in weights.items()})
    source = VLASource(data_set, images="openvla_oft")
    return StoredVLA(network, normalizer, LlamaTokenizer.from_file(path / "tokenizer.json"), source)


# -- files -------------------------------------------------------------------------------------------------------------


def _image_size(path: Path, heads: int) -> int:
    config = read_json(path, dict[str, Any])
    if config.get("model_type") != "openvla":
        raise InputError(f"{path}: model_type: expected 'openvla', got {config.get('model_type')!r}")
    text = config.get("text_config", {})
    fixed = _FIXED_TEXT | {"num_attention_heads": heads, "num_key_value_heads": heads}
    for where, found, values in (("", config, _FIXED), ("text_config.", text, fixed)):
        for name, value in values.items():
            if found.get(name, value) != value:
                raise InputError(f"{path}: {where}{name}: expected {value}, got {found[name]}")
    sizes = config.get("image_sizes")
    if not isinstance(sizes, list) or len({*sizes}) != 1:
        raise InputError(f"{path}: image_sizes: expected one size for both towers, got {sizes}")
    return sizes[0]


def _read_shards(path: Path) -> dict[str, Tensor]:
    index = path / "model.safetensors.index.json"
    weight_map = read_json(index, dict[str, Any]).get("weight_map") or {}
    shards = sorted({*weight_map.values()})
    if not shards or any(Path(name).name != name for name in shards):
        raise InputError(f"{index}: weight_map: expected file names in this folder, got {shards}")
    tensors: dict[str, Tensor] = {}
    for name in shards:
        tensors |= read_tensors(path / name)
    missing = sorted(weight_map.keys() - tensors.keys())
    if missing:
        raise InputError(f"{index}: expected tensors in {shards} that are not there: {missing}")
    return tensors


def _read_part(path: Path, prefix: str) -> dict[str, Tensor]:
    """Read the tensors of the one file ``action_head--*`` or ``proprio_projector--*``, under ``prefix``."""
    pattern = f"{prefix.rstrip('.')}*checkpoint*"
    files = sorted(path.glob(pattern))
    if len(files) != 1:
        found = [file.name for file in files]
        needed = "; a policy without is not supported" if not files else ""
        raise InputError(f"{path}: expected exactly one file {pattern}, got {found}{needed}")
    try:
        with TorchArchive(files[0]) as archive:
            tensors = {name: archive.tensor(value) for name, value in archive.contents().items()}
    except (AttributeError, ValueError) as error:  # AttributeError: it holds anything but tensors by name
        raise InputError(f"{files[0]}: expected a file of tensors, got: {error}") from error
    return {prefix + name: value for name, value in without_wrappers(str(files[0]), tensors).items()}


# -- sizes and names ---------------------------------------------------------------------------------------------------


def _config(path: Path, tensors: dict[str, Tensor], image_size: int, unsaid: Unsaid) -> VLAConfig:
    """Infer the sizes from the shapes of the weights; InputError if they are not those of LIBERO's arm."""

    def shape(name: str) -> tuple[int, ...]:
        if name not in tensors:
            raise InputError(f"{path}: expected a tensor {name}, got none of that name")
        return tuple(tensors[name].shape)

    def size(prefix: str, blocks: str, mlp: str, dim: int, heads: int) -> TransformerSize:
        pattern = re.compile(re.escape(prefix + blocks) + r"\.(\d+)\.")
        layers = {match[1] for match in map(pattern.match, tensors) if match}
        return TransformerSize(dim, len(layers), heads, shape(f"{prefix}{blocks}.0.{mlp}.weight")[0])

    vocab_size, width = shape(_LLM + "embed_tokens.weight")
    patch = shape(_DINO + "patch_embed.proj.weight")
    found = shape(_PROPRIO + "fc1.weight")[1], shape(_HEAD + "model.fc2.weight")[0]
    if found != (STATE_DIM, ACTION_DIM):
        raise InputError(
            f"{path}: expected a policy of LIBERO's {STATE_DIM} numbers of the state and {ACTION_DIM} of an action, got one of "
            f"{found[0]} and {found[1]}"
        )
    heads = unsaid.heads
    return VLAConfig(
        dino=size(_DINO, "blocks", "mlp.fc1", patch[0], heads[0]),
        siglip=size(_SIGLIP, "blocks", "mlp.fc1", shape(_SIGLIP + "pos_embed")[2], heads[1]),
        llm=size(_LLM, "layers", "mlp.gate_proj", width, heads[2]),
        vocab_size=vocab_size,
        image_size=image_size,
        patch_size=patch[2],
        registers=shape(_DINO + "reg_token")[1],
        cameras=VLAConfig().cameras[: unsaid.cameras],
        state_dim=STATE_DIM,
        action_dim=ACTION_DIM,
        chunk_size=unsaid.chunk_size,
        crop_area=0.9 if unsaid.center_crop else 1.0,
    )


def _rename(tensors: dict[str, Tensor], config: VLAConfig) -> dict[str, Tensor]:
    """Rename the weights to those of `VLANetwork`; ``tensors`` is used up."""
    dino, siglip = take(tensors, _DINO), take(tensors, _SIGLIP)
    # there, the class token has no position
    positions = torch.cat([torch.zeros_like(dino["pos_embed"][:, :1]), dino.pop("pos_embed")], dim=1)
    dino_weights = _tower(dino, _DINO_NAMES, "encoder.layer", config.dino.layers)
    dino_weights["embeddings.position_embeddings"] = positions
    dino_weights["embeddings.mask_token"] = torch.zeros(1, config.dino.dim)
    positions = siglip.pop("pos_embed")[0]
    siglip_weights = _tower(siglip, _SIGLIP_NAMES, "encoder.layers", config.siglip.layers)
    siglip_weights["embeddings.position_embedding.weight"] = positions
    parts = {
        "vision.dino.": dino_weights,
        "vision.siglip.": siglip_weights,
        "projector.": take(tensors, "projector."),
        "proprio.": take(tensors, _PROPRIO),
        "decoder.llama.": take(tensors, _LLM),
        "head.": {_replace(name, _HEAD_NAMES): value for name, value in take(tensors, _HEAD).items()},
    }
    take(tensors, "language_model.lm_head.")
    return {prefix + name: v for prefix, part in parts.items() for name, v in part.items()} | tensors


def _tower(tensors: dict[str, Tensor], names: dict[str, str], blocks: str, layers: int) -> dict[str, Tensor]:
    """Rename a tower's weights, without those that nothing reads, and with query, key and value apart."""
    unused = (f"{blocks}.{layers - 1}.", "norm.", "attn_pool.")
    renamed = {_replace(name, names): value for name, value in tensors.items()}
    renamed = {name: value for name, value in renamed.items() if not name.startswith(unused)}
    for name in [name for name in renamed if ".qkv." in name]:
        parts = renamed.pop(name).chunk(3)
        renamed |= {name.replace("qkv", f"{c}_proj"): v for c, v in zip("qkv", parts, strict=True)}
    return renamed


def _replace(name: str, names: dict[str, str]) -> str:
    for old, new in names.items():
        name = name.replace(old, new)
    return name
