"""Policies that LeRobot 0.6 saved: ``multi_task_dit``, a diffusion transformer with adaptive layer norms.

The folder is what ``save_pretrained`` writes: ``config.json``, ``model.safetensors`` and the processors' files. Nothing in it
is executed, and LeRobot is not needed. An entry that would change an answer and is not supported is refused by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.clip_encoder import ClipEncoder
from torchrl_sparse.networks.normalize import ShiftedNormalizer
from torchrl_sparse.storage.diffusion import StoredPolicy
from torchrl_sparse.storage.json import read_json
from torchrl_sparse.storage.lerobot.clip_files import clip_facts, find_tokenizer
from torchrl_sparse.storage.lerobot.config import (
    ACTION,
    STATE,
    MultiTaskDitConfig,
    is_lerobot,
    read_config,
    read_sampler,
)
from torchrl_sparse.storage.lerobot.processors import Processors, read_processors
from torchrl_sparse.storage.lerobot.weights import WEIGHTS, load_weights, shapes_in, text_sizes, vision_sizes
from torchrl_sparse.storage.tensors import check_folder

__all__ = ["is_lerobot", "read_lerobot"]


def read_lerobot(
    folder: Path, *, task: str | None = None, tokens: Mapping[str, Sequence[int]] | None = None
) -> StoredPolicy:
    """Read a folder.

    Args:
        folder: what LeRobot's ``save_pretrained`` wrote, such as ``checkpoints/last/pretrained_model``.
        task: the instruction of calls that bring none.
        tokens: token ids of instructions, for a policy without ``tokenizer.json`` beside it.

    Raises:
        FileNotFoundError: if a file is not there.
        InputError: naming file and entry, what was expected and what came.
    """
    check_folder(folder)
    config = read_config(folder)
    try:
        sampler = read_sampler(config)
    except ValueError as error:
        raise InputError(f"{folder / 'config.json'}: {error}") from error
    shapes: dict[str, tuple[int, ...]] = {STATE: (config.state_dim,), ACTION: (config.action_dim,)}
    shapes |= {key: tuple(config.input_features[key].shape) for key in config.image_keys}
    processors = read_processors(folder, shapes)
    file = folder / WEIGHTS
    found = shapes_in(file)
    with torch.device("meta"):  # the configuration is compared with the weights before memory is taken for it
        arguments = _arguments(folder, config, found)
        expected = _make(folder, *arguments)
    tensors = load_weights(file, found, config, *expected)
    network, vision = _make(folder, *arguments)
    network.load_state_dict(tensors[0])
    vision.load_state_dict(tensors[1], strict=False)  # but for the cameras' statistics, which are set next
    _set_pixels(vision, config, processors)
    maps = [processors.maps[name] for name in (STATE, ACTION)]
    normalizer = ShiftedNormalizer(
        *(part for one in maps for part in (one.scale, one.offset)),
        state_shift=maps[0].shift,
        action_shift=maps[1].shift,
    )
    source = _source(folder, config, task, tokens)
    vision.know(source)
    vision.tokenize = find_tokenizer(folder, processors.tokenizer, config.text_encoder_name)
    return StoredPolicy(network.eval(), normalizer, sampler, vision.eval(), source)


def _make(
    folder: Path, network: dict[str, Any], vision: dict[str, Any]
) -> tuple[AdaLNTransformer, ClipEncoder]:
    try:
        return AdaLNTransformer(**network), ClipEncoder(**vision)
    except ValueError as error:
        raise InputError(f"{folder / 'config.json'}: {error}") from error


def _arguments(
    folder: Path, config: MultiTaskDitConfig, found: Mapping[str, tuple[int, ...]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arguments of network and encoder, of the configuration and, of CLIP, of the weights' shapes."""
    text = text_sizes(
        folder / WEIGHTS,
        found,
        clip_facts(folder, "text_encoder_name", config.text_encoder_name, "text_config"),
    )
    vision: dict[str, Any] | None = None
    if config.image_keys:
        name = config.vision_encoder_name
        facts = clip_facts(folder, "vision_encoder_name", name, "vision_config")
        vision = vision_sizes(folder / WEIGHTS, found, facts, config.use_separate_rgb_encoder_per_camera)
    features = 0 if vision is None else len(config.image_keys) * vision["width"]
    network = {
        "input_dim": config.action_dim,
        "horizon": config.horizon,
        "n_obs_steps": config.n_obs_steps,
        "cond_dim": features + config.hidden_dim + config.state_dim,
        "n_layer": config.num_layers,
        "n_head": config.num_heads,
        "n_emb": config.hidden_dim,
        "time_dim": config.timestep_embed_dim,
        "rope_base": config.rope_base if config.use_rope else None,
        "positions": config.use_positional_encoding,
    }
    encoder = {
        "cameras": list(config.cameras),
        "image_size": config.image_size,
        "resize": config.image_resize_shape if vision else None,
        "crop": config.crop if vision else None,
        "vision": vision,
        "separate": config.use_separate_rgb_encoder_per_camera,
        "text": text,
        "text_dim": config.hidden_dim,
    }
    return network, encoder


def _set_pixels(vision: ClipEncoder, config: MultiTaskDitConfig, processors: Processors) -> None:
    for index, key in enumerate(config.image_keys):
        one = processors.maps[key]
        for name, value in (("shift", one.shift), ("scale", one.scale), ("offset", one.offset)):
            getattr(vision, f"pixel_{name}")[index] = value


def _source(
    folder: Path,
    config: MultiTaskDitConfig,
    task: str | None,
    tokens: Mapping[str, Sequence[int]] | None,
) -> dict[str, Any]:
    """Return where the policy comes from and how to feed it, see `StoredPolicy`."""
    if task is not None and (not isinstance(task, str) or not task):
        raise InputError(f"task: expected an instruction, got {task!r}")
    known = {text: [int(number) for number in ids] for text, ids in (tokens or {}).items()}
    source: dict[str, Any] = {
        "lerobot": config.type,
        "n_action_steps": min(config.n_action_steps, config.horizon - config.n_obs_steps + 1),
        "state": {STATE: config.state_dim},
        "cameras": config.cameras,
        "control_freq": _rate(folder / "train_config.json"),
        "instructions": known,
        "instruction": task if task is not None or len(known) != 1 else next(iter(known)),
    }
    return {name: value for name, value in source.items() if value is not None}


def _rate(file: Path) -> float | None:
    """Return the actions a second of the environment that it was evaluated in while training, if a file notes one."""
    if not file.is_file():
        return None
    env = read_json(file, dict[str, Any]).get("env")
    rate = env.get("fps") if isinstance(env, dict) else None
    return rate if isinstance(rate, (int, float)) and not isinstance(rate, bool) and rate > 0 else None
