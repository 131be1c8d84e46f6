"""``model.safetensors`` of LeRobot's ``multi_task_dit`` under this library's names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.clip_encoder import ClipEncoder
from torchrl_sparse.storage.lerobot.clip_files import ClipFacts
from torchrl_sparse.storage.lerobot.config import MultiTaskDitConfig
from torchrl_sparse.storage.tensors import read_tensors

__all__ = ["WEIGHTS", "load_weights", "shapes_in", "text_sizes", "vision_sizes"]

WEIGHTS = "model.safetensors"
_NETWORK, _ENCODER = "noise_predictor.", "observation_encoder."
_TEXT = _ENCODER + "text_encoder.text_encoder."
_UNUSED = re.compile(r".*\.post_layernorm\.(weight|bias)")  # of CLIP's pooled output, which is not read
_WITHOUT_ROPE = {
    "attn.qkv_proj.weight": "multihead_attn.in_proj_weight",
    "attn.qkv_proj.bias": "multihead_attn.in_proj_bias",
    "attn.out_proj.weight": "multihead_attn.out_proj.weight",
    "attn.out_proj.bias": "multihead_attn.out_proj.bias",
}

Shapes = Mapping[str, tuple[int, ...]]


def shapes_in(file: Path) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor in a file without reading one.

    Raises:
        FileNotFoundError: if it is not there.
        InputError: naming it, if it is damaged or one of several.
    """
    if not file.is_file():
        if file.with_name(f"{WEIGHTS}.index.json").is_file() or [*file.parent.glob("model-*.safetensors")]:
            raise InputError(
                f"{file}: expected all weights in one file, got shards; save the policy again with LeRobot's save_pretrained"
            )
        if file.with_name("adapter_model.safetensors").is_file():
            raise InputError(
                f"{file}: expected merged weights, got an adapter; merge it with PEFT and save the policy"
            )
        raise FileNotFoundError(f"expected a file {file}, got none")
    try:
        with safe_open(file, "pt") as opened:
            return {name: tuple(opened.get_slice(name).get_shape()) for name in opened.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise InputError(f"{file}: expected a complete safetensors file, got: {error}") from error


def text_sizes(file: Path, shapes: Shapes, facts: ClipFacts) -> dict[str, Any]:
    """Return the arguments of `ClipText` that the weights' shapes and CLIP's facts say."""
    prefix = _TEXT + _inner(shapes, _TEXT, "text_model.")
    words, width = _shape(file, shapes, prefix + "embeddings.token_embedding.weight", 2)
    tokens, _ = _shape(file, shapes, prefix + "embeddings.position_embedding.weight", 2)
    return {"words": words, "tokens": tokens, "end": facts.end, **_tower(file, shapes, prefix, width, facts)}


def vision_sizes(file: Path, shapes: Shapes, facts: ClipFacts, separate: bool) -> dict[str, Any]:
    """Return the arguments of `ClipVision` that the weights' shapes and CLIP's facts say."""
    prefix = _vision(shapes, 0 if separate else None)
    width, _, patch, _ = _shape(file, shapes, prefix + "embeddings.patch_embedding.weight", 4)
    places, _ = _shape(file, shapes, prefix + "embeddings.position_embedding.weight", 2)
    side = round((places - 1) ** 0.5)
    return {"size": side * patch, "patch": patch, **_tower(file, shapes, prefix, width, facts)}


def load_weights(
    file: Path, found: Shapes, config: MultiTaskDitConfig, network: AdaLNTransformer, vision: ClipEncoder
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Read all weights, f32.

    Args:
        file: that holds them.
        found: its shapes.
        config: of the policy.
        network, vision: what is expected, on the meta device.

    Returns:
        the states of network and encoder, the latter without the cameras' statistics.

    Raises:
        InputError: naming the tensor, if one is missing, unknown, of another shape or not finite.
    """
    names = {_network_name(name, config.use_rope): name for name in network.state_dict()}
    seen = {
        _vision_name(found, name, config): name
        for name in vision.state_dict()
        if not name.startswith("pixel_")
    }
    expected = {name: network.state_dict()[own] for name, own in names.items()}
    expected |= {name: vision.state_dict()[own] for name, own in seen.items()}
    unused = {
        name: torch.empty(shape, device="meta") for name, shape in found.items() if _UNUSED.fullmatch(name)
    }
    tensors = {name: value.float() for name, value in read_tensors(file, expected | unused).items()}
    state = {own: _ordered(own, tensors[name], config, vision) for name, own in names.items()}
    return state, {own: tensors[name] for name, own in seen.items()}


def _ordered(name: str, value: Tensor, config: MultiTaskDitConfig, vision: ClipEncoder) -> Tensor:
    """Put a modulation's columns in this library's order: in each observation, the state comes last."""
    if not name.endswith("adaLN_modulation.1.weight"):
        return value
    time, cond = value.split([config.timestep_embed_dim, value.shape[1] - config.timestep_embed_dim], dim=1)
    steps = cond.unflatten(1, (config.n_obs_steps, -1))
    state, features = steps.split([config.state_dim, vision.feature_dim + vision.text_dim], dim=2)
    return torch.cat([time, torch.cat([features, state], dim=2).flatten(1)], dim=1)


def _network_name(name: str, rope: bool) -> str:
    if not rope:
        for own, other in _WITHOUT_ROPE.items():
            name = name.replace(own, other)
    return _NETWORK + name


def _vision_name(shapes: Shapes, name: str, config: MultiTaskDitConfig) -> str:
    part, _, rest = name.partition(".")
    if part == "towers":
        number, _, rest = rest.partition(".")
        return _vision(shapes, int(number) if config.use_separate_rgb_encoder_per_camera else None) + rest
    if part == "text":
        return _TEXT + _inner(shapes, _TEXT, "text_model.") + rest
    return f"{_ENCODER}text_encoder.{name}"


def _vision(shapes: Shapes, number: int | None) -> str:
    prefix = _ENCODER + ("vision_encoder." if number is None else f"vision_encoders.{number}.") + "model."
    return prefix + _inner(shapes, prefix, "vision_model.")


def _inner(shapes: Shapes, prefix: str, name: str) -> str:
    """Return the module that older versions of transformers have around a tower."""
    return name if any(key.startswith(prefix + name) for key in shapes) else ""


def _tower(file: Path, shapes: Shapes, prefix: str, width: int, facts: ClipFacts) -> dict[str, Any]:
    layer = re.compile(re.escape(prefix) + r"encoder\.layers\.(\d+)\.")
    layers = {int(match[1]) for name in shapes if (match := layer.match(name))}
    inner, _ = _shape(file, shapes, prefix + "encoder.layers.0.mlp.fc1.weight", 2)
    return {
        "width": width,
        "heads": facts.heads,
        "layers": len(layers),
        "inner": inner,
        "act": facts.act,
        "eps": facts.eps,
    }


def _shape(file: Path, shapes: Shapes, name: str, axes: int) -> tuple[int, ...]:
    shape = shapes.get(name)
    if shape is None or len(shape) != axes:
        raise InputError(f"{file}: {name}: expected a tensor of {axes} axes, got {shape or 'none'}")
    return shape
