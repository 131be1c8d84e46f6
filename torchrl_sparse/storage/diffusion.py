"""Files of a diffusion policy: ``config.json``, ``model.safetensors`` and optional others. None can contain executable code.

::

    {"format": "torchrl_sparse.diffusion_policy/1",
     "network": {arguments of TransformerForDiffusion; with "type": "adaln", of AdaLNTransformer},
     "schedule": {arguments of Sampler},
     "plan": "plan.json" or "plan", a planner's file or folder beside this one; only where something is pruned,
     "warm_start": steps of a policy call that begins from the last chunk; only where not all begin from noise,
     "engine": "native_int8" or "native_bf16"; only where the policy runs with rounded weights,
     "vision": {arguments of VisionEncoder, or with "type": "clip" of ClipEncoder; only where there are any},
     "normalizer": "shifted", only of a ShiftedNormalizer,
     "source": {where an imported policy comes from; only there}}

Weights of the cameras' encoder are in ``vision.safetensors``, where there are cameras. Weights are fp16 unless full precision
is asked for, normalisation constants fp32.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.clip_encoder import ClipEncoder
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer, ShiftedNormalizer
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.storage.tensors import check_folder, read_tensors, take, write_tensors

FORMAT: Literal["torchrl_sparse.diffusion_policy/1"] = "torchrl_sparse.diffusion_policy/1"
T = TypeVar("T")
PlanName = Literal["plan.json", "plan"]  # of fixed names alone: a file cannot ask for one elsewhere
RoundedEngine = Literal["native_bf16", "native_int8"]  # what is no choice of speed alone
_NETWORK, _NORMALIZER = "network.", "normalizer."
_ADALN, _CLIP = "adaln", "clip"
_SHIFTED: Literal["shifted"] = "shifted"


@dataclass(frozen=True)
class _Config:
    """The content of ``config.json``."""

    format: Literal["torchrl_sparse.diffusion_policy/1"]
    network: dict[str, Any]
    schedule: dict[str, Any]
    vision: dict[str, Any] | None = None
    source: dict[str, Any] | None = None
    plan: PlanName | None = None
    warm_start: int | None = None
    engine: RoundedEngine | None = None
    normalizer: Literal["shifted"] | None = None


@dataclass(frozen=True)
class StoredPolicy:
    """Parts of a policy that are stored in files.

    Attributes:
        network: the denoiser, f32, in evaluation mode.
        normalizer: of states and actions.
        sampler: the sampler.
        vision: encoder of the cameras, and perhaps of instructions, f32, in evaluation mode.
        source: where an imported policy comes from and how to feed it; empty for policies trained here.
            ``"weights"`` ("ema_model" or "model"), ``"task"``, ``"epoch"``, ``"n_action_steps"`` to execute of a
            chunk, ``"abs_action"``, whether actions say where to go, ``"robosuite"``, the version whose observations
            it was trained on, ``"control_freq"``, its actions a second, ``"state_keys"``, robomimic's names of the
            observations that make up the state, in order, ``"cameras"``, name of the image here -> robomimic's, and of
            LeRobot's policies ``"instructions"``, text -> token ids, and ``"instruction"``, the text of a call without one;
            None or nothing for what a checkpoint does not say.
        plan: name of the planner's file or folder, beside the other files; None if nothing is pruned.
        warm_start: steps of a policy call that begins from the last chunk; None if all begin from noise.
        engine: that rounds weights and activations; None if nothing is rounded.
    """

    network: Denoiser
    normalizer: Normalizer
    sampler: Sampler
    vision: VisionEncoder | ClipEncoder | None = None
    source: dict[str, Any] = field(default_factory=dict)
    plan: PlanName | None = None
    warm_start: int | None = None
    engine: RoundedEngine | None = None


def write_pretrained(path: Path, policy: StoredPolicy, *, half: bool = True) -> None:
    """Write the files into the folder ``path``, each atomically; ``half`` stores fp16 weights."""
    vision = None if policy.vision is None else policy.vision.config
    adaptive = isinstance(policy.network, AdaLNTransformer)
    network = ({"type": _ADALN} if adaptive else {}) | policy.network.config
    schedule, shifted = policy.sampler.config, isinstance(policy.normalizer, ShiftedNormalizer)
    kept = policy.plan, policy.warm_start, policy.engine
    source, normalizer = policy.source or None, _SHIFTED if shifted else None
    config = _Config(FORMAT, network, schedule, vision, source, *kept, normalizer)
    tensors = {_NETWORK + name: value for name, value in _weights(policy.network, half).items()}
    tensors |= {_NORMALIZER + name: value for name, value in policy.normalizer.state_dict().items()}
    write_tensors(path / "model.safetensors", tensors)
    if policy.vision is not None:
        write_tensors(path / "vision.safetensors", _weights(policy.vision, half))
    write_json(path / "config.json", config)


def _weights(module: nn.Module, half: bool) -> dict[str, Tensor]:
    return {name: value.half() if half else value for name, value in module.state_dict().items()}


def read_pretrained(path: Path) -> StoredPolicy:
    """Read a policy from the folder ``path``, its network in evaluation mode.

    Raises:
        FileNotFoundError: if a file is not there.
        InputError: naming the file, what was expected and what came.
    """
    check_folder(path)
    config = read_json(path / "config.json", _Config)
    sampler = _make(path / "config.json", "schedule", Sampler, config.schedule)
    _check_warm_start(path / "config.json", config.warm_start, sampler)
    with torch.device("meta"):  # the configuration is compared with the weights before memory is taken for it
        network, vision = _networks(path / "config.json", config)
        expected = _state(network, vision, shifted=config.normalizer is not None)
    tensors = read_tensors(path / "model.safetensors", expected)
    seen = {} if vision is None else read_tensors(path / "vision.safetensors", vision.state_dict())
    network, vision = _networks(path / "config.json", config)
    _load(network, take(tensors, _NETWORK))
    if vision is not None:
        _load(vision, seen)
    kind = Normalizer if config.normalizer is None else ShiftedNormalizer
    normalizer = _make(path / "model.safetensors", "normalizer", kind, take(tensors, _NORMALIZER))
    if isinstance(vision, ClipEncoder):
        try:
            vision.know(config.source or {})
        except (TypeError, ValueError) as error:
            raise InputError(f"{path / 'config.json'}: source: {error}") from error
    kept = config.plan, config.warm_start, config.engine
    return StoredPolicy(network, normalizer, sampler, vision, config.source or {}, *kept)


def _load(module: nn.Module, weights: Mapping[str, Tensor]) -> None:
    module.load_state_dict({name: value.float() for name, value in weights.items()})
    module.eval()


def _check_warm_start(file: Path, steps: int | None, sampler: Sampler) -> None:
    if steps is not None and not 1 <= steps < sampler.num_inference_steps:
        most = sampler.num_inference_steps - 1
        raise InputError(f"{file}: warm_start: expected 1 to {most} of the schedule's steps, got {steps}")


def _networks(file: Path, config: _Config) -> tuple[Denoiser, VisionEncoder | ClipEncoder | None]:
    """Make the untrained networks that a configuration describes."""
    made: Callable[..., Denoiser] = TransformerForDiffusion
    arguments = dict(config.network)
    if arguments.get("type") == _ADALN:
        made = AdaLNTransformer
        del arguments["type"]
    network = _make(file, "network", made, arguments)
    if config.vision is None:
        return network, None
    arguments = dict(config.vision)
    if arguments.get("type") == _CLIP:
        del arguments["type"]
        return network, _make(file, "vision", ClipEncoder, arguments)
    return network, _make(file, "vision", VisionEncoder, arguments)


def _state(
    network: Denoiser, vision: VisionEncoder | ClipEncoder | None, *, shifted: bool
) -> dict[str, Tensor]:
    """Return all tensors that ``model.safetensors`` must hold; only their shapes count."""
    state_dim = network.cond_dim - (0 if vision is None else vision.feature_dim + vision.text_dim)
    sizes = {"state": max(state_dim, 0), "action": network.input_dim}
    tensors = {
        f"{_NORMALIZER}{name}_{part}": torch.empty(size)
        for name, size in sizes.items()
        for part in ("scale", "offset", *(("shift",) if shifted else ()))
    }
    return tensors | {_NETWORK + name: value for name, value in network.state_dict().items()}


def _make(file: Path, field: str, kind: Callable[..., T], arguments: dict[str, Any]) -> T:
    try:
        return kind(**arguments)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}: {field}: {error}") from error
