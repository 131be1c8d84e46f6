"""``config.json`` of a policy that LeRobot saved: every entry of 0.6.1, strictly typed, and which values are supported."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.storage.json import read_json

__all__ = ["ACTION", "STATE", "Feature", "MultiTaskDitConfig", "is_lerobot", "read_config", "read_sampler"]

STATE, ACTION, _ENVIRONMENT = "observation.state", "action", "observation.environment_state"
_IMAGE = re.compile(r"observation\.image(?:s\.([^.]+))?")
_NAME = "config.json"


@dataclass(frozen=True)
class Feature:
    """An input or output: its kind, and its shape without a batch."""

    type: Literal["STATE", "VISUAL", "ENV", "ACTION"]
    shape: list[int]


@dataclass(frozen=True)
class MultiTaskDitConfig:
    """The entries, with LeRobot's defaults. Those of training, of the hub and of devices have no effect on an answer."""

    type: Literal["multi_task_dit"]
    input_features: dict[str, Feature]
    output_features: dict[str, Feature]
    n_obs_steps: int = 2
    horizon: int = 32
    n_action_steps: int = 24
    objective: Literal["diffusion", "flow_matching"] = "diffusion"
    noise_scheduler_type: Literal["DDPM", "DDIM"] = "DDPM"
    num_train_timesteps: int = 100
    beta_schedule: Literal["squaredcos_cap_v2"] = "squaredcos_cap_v2"
    prediction_type: Literal["epsilon", "sample"] = "epsilon"
    clip_sample: bool = True
    clip_sample_range: float = 1.0
    num_inference_steps: int | None = None
    num_integration_steps: int = 100
    integration_method: Literal["euler"] = "euler"
    hidden_dim: int = 512
    num_layers: int = 6
    num_heads: int = 8
    use_positional_encoding: bool = False
    timestep_embed_dim: int = 256
    use_rope: bool = True
    rope_base: float = 10000.0
    vision_encoder_name: str = "openai/clip-vit-base-patch16"
    use_separate_rgb_encoder_per_camera: bool = False
    image_resize_shape: list[int] | None = None
    image_crop_shape: list[int] | None = field(default_factory=lambda: [224, 224])
    text_encoder_name: str = "openai/clip-vit-base-patch16"
    use_peft: Literal[False] = False
    # What processors hold again, which are what is used.
    tokenizer_max_length: int = 77
    tokenizer_padding: str = "max_length"
    tokenizer_padding_side: str = "right"
    tokenizer_truncation: bool = True
    normalization_mapping: dict[str, str] = field(default_factory=dict)
    # Of no effect: betas of other schedules, training, hub and device.
    beta_start: float = 1e-4
    beta_end: float = 0.02
    sigma_min: float = 0.0
    timestep_sampling_strategy: str = "beta"
    timestep_sampling_s: float = 0.999
    timestep_sampling_alpha: float = 1.5
    timestep_sampling_beta: float = 1.0
    dropout: float = 0.1
    vision_encoder_lr_multiplier: float = 0.1
    image_crop_is_random: bool = True
    optimizer_lr: float = 2e-5
    optimizer_betas: list[float] = field(default_factory=list)
    optimizer_eps: float = 1e-8
    optimizer_weight_decay: float = 0.0
    scheduler_name: str = "cosine"
    scheduler_warmup_steps: int = 0
    do_mask_loss_for_padding: bool = False
    drop_n_last_frames: int | None = None
    device: str | None = None
    use_amp: bool = False
    push_to_hub: bool = True
    repo_id: str | None = None
    private: bool | None = None
    tags: list[str] | None = None
    license: str | None = None
    pretrained_path: str | None = None
    pretrained_revision: str | None = None

    @property
    def state_dim(self) -> int:
        return self.input_features[STATE].shape[0]

    @property
    def action_dim(self) -> int:
        return self.output_features[ACTION].shape[0]

    @property
    def cameras(self) -> dict[str, str]:
        """Name of an image here -> LeRobot's, in order."""
        found = {key: _IMAGE.fullmatch(key) for key in self.image_keys}
        return {(match[1] or "image") if match else key: key for key, match in found.items()}

    @property
    def image_keys(self) -> list[str]:
        return [key for key, feature in self.input_features.items() if feature.type == "VISUAL"]

    @property
    def image_size(self) -> tuple[int, int]:
        """Height and width of images; 0 without cameras."""
        keys = self.image_keys
        height, width = self.input_features[keys[0]].shape[1:] if keys else (0, 0)
        return height, width

    @property
    def crop(self) -> list[int] | None:
        """The part that is seen; None where it does not fit, as LeRobot leaves it out then."""
        crop, whole = self.image_crop_shape, self.image_resize_shape or self.image_size
        fits = crop is not None and crop[0] <= whole[0] and crop[1] <= whole[1]
        return crop if fits else None


def is_lerobot(folder: Path) -> bool:
    """Tell whether the ``config.json`` of a folder names a policy's ``type``, as LeRobot's do and this library's do not."""
    file = folder / _NAME
    return file.is_file() and "type" in (found := read_json(file, dict[str, Any])) and "format" not in found


def read_config(folder: Path) -> MultiTaskDitConfig:
    """Read ``config.json``.

    Raises:
        FileNotFoundError: if it is not there.
        InputError: naming file and entry, what was expected and what came.
    """
    file = folder / _NAME
    kind = read_json(file, dict[str, Any]).get("type")
    if kind != "multi_task_dit":
        raise InputError(
            f"{file}: type: expected 'multi_task_dit', LeRobot's diffusion transformer, got {kind!r}; "
            "policies of other types cannot be imported"
        )
    config = read_json(file, MultiTaskDitConfig)
    try:
        _check(config)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from error
    return config


def read_sampler(config: MultiTaskDitConfig) -> Sampler:
    """Make the sampler of the objective; ValueError, naming the entry, if there is none such."""
    if config.objective == "flow_matching":
        return _named("num_integration_steps", lambda: Sampler("flow", config.num_integration_steps))
    options: dict[str, Any] = {
        "clip_sample_range": config.clip_sample_range if config.clip_sample else None,
        "prediction": config.prediction_type,
    }
    kind, steps = config.noise_scheduler_type.lower(), config.num_inference_steps
    return _named("num_inference_steps", lambda: Sampler(kind, steps, config.num_train_timesteps, **options))


def _named(entry: str, make: Any) -> Sampler:
    try:
        return make()
    except ValueError as error:
        text = str(error)
        raise InputError(text if text.startswith(entry) else f"{entry}: {text}") from error


def _check(config: MultiTaskDitConfig) -> None:
    _one("input_features", config.input_features, STATE, "STATE")
    _one("output_features", config.output_features, ACTION, "ACTION")
    extra = [key for key in config.output_features if key != ACTION]
    extra += [key for key, one in config.input_features.items() if key != STATE and not _known(key, one)]
    if extra:
        raise InputError(
            f"input_features, output_features: expected {STATE}, cameras and {ACTION}, got {', '.join(extra)} too"
        )
    sizes = {tuple(config.input_features[key].shape) for key in config.image_keys}
    if len(sizes) > 1 or any(len(size) != 3 or size[0] != 3 or min(size) < 1 for size in sizes):
        raise InputError(f"input_features: expected images of one shape [3, h, w], got {sorted(sizes)}")
    if len(config.cameras) < len(config.image_keys):
        raise InputError(f"input_features: expected cameras of different names, got {config.image_keys}")
    for name in ("image_resize_shape", "image_crop_shape"):
        shape = getattr(config, name)
        if shape is not None and (len(shape) != 2 or min(shape) < 1):
            raise InputError(f"{name}: expected height and width, got {shape}")
    if config.n_action_steps < 1:
        raise InputError(f"n_action_steps: expected a number of at least 1, got {config.n_action_steps}")
    if config.n_obs_steps > config.horizon:
        raise InputError(f"horizon: expected at least n_obs_steps={config.n_obs_steps}, got {config.horizon}")


def _known(key: str, feature: Feature) -> bool:
    if feature.type == "ENV":
        return key == _ENVIRONMENT  # which the network does not read
    return feature.type == "VISUAL" and _IMAGE.fullmatch(key) is not None


def _one(place: str, features: dict[str, Feature], key: str, kind: str) -> None:
    found = features.get(key)
    if found is None or found.type != kind or len(found.shape) != 1 or found.shape[0] < 1:
        raise InputError(f"{place}: expected {key} of type {kind} and shape [n], got {found or 'none'}")
