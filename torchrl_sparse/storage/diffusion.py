"""A diffusion policy as two files: ``config.json`` and ``model.safetensors``. Neither can hold anything that executes.

::

    {"format": "torchrl_sparse.diffusion_policy/1",
     "network": {arguments of TransformerForDiffusion},
     "schedule": {arguments of Sampler},
     "vision": {arguments of VisionEncoder; only where there are cameras},
     "source": {where an imported policy comes from; only there}}

Network weights are fp16 unless full precision is asked for, normalisation constants fp32.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from torch import Tensor, nn

from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.storage.json import read_json, write_json
from torchrl_sparse.storage.tensors import check_tensors, read_tensors, take, write_tensors

FORMAT = "torchrl_sparse.diffusion_policy/1"
T = TypeVar("T")
_NETWORK, _NORMALIZER, _VISION = "network.", "normalizer.", "vision."


@dataclass(frozen=True)
class _Config:
    """The content of ``config.json``."""

    format: Literal["torchrl_sparse.diffusion_policy/1"]
    network: dict[str, Any]
    schedule: dict[str, Any]
    vision: dict[str, Any] | None = None
    source: dict[str, Any] | None = None


@dataclass(frozen=True)
class StoredPolicy:
    """The parts of a policy that files hold.

    Attributes:
        network: the denoiser, f32, in evaluation mode.
        normalizer: of states and actions.
        sampler: the sampler.
        vision: encoder of the cameras, f32, in evaluation mode.
        source: where an imported policy comes from and how to feed it; empty for policies trained here.
            ``"weights"`` ("ema_model" or "model"), ``"task"``, ``"epoch"``, ``"n_action_steps"`` to execute of a
            chunk, ``"state_keys"``, robomimic's names of the observations that make up the state, in order, and
            ``"cameras"``, name of the image here -> robomimic's; None for what a checkpoint does not say.
    """

    network: TransformerForDiffusion
    normalizer: Normalizer
    sampler: Sampler
    vision: VisionEncoder | None = None
    source: dict[str, Any] = field(default_factory=dict)


def write_pretrained(path: Path, policy: StoredPolicy, *, half: bool = True) -> None:
    """Write both files into the folder ``path``, each in one piece or not at all; ``half`` stores fp16 weights."""
    vision = None if policy.vision is None else policy.vision.config
    config = _Config(FORMAT, policy.network.config, policy.sampler.config, vision, policy.source or None)
    weights = {_NETWORK + name: value for name, value in policy.network.state_dict().items()}
    if policy.vision is not None:
        weights |= {_VISION + name: value for name, value in policy.vision.state_dict().items()}
    tensors = {name: value.half() if half else value for name, value in weights.items()}
    tensors |= {_NORMALIZER + name: value for name, value in policy.normalizer.state_dict().items()}
    write_tensors(path / "model.safetensors", tensors)
    write_json(path / "config.json", config)


def read_pretrained(path: Path) -> StoredPolicy:
    """Read the policy in the folder ``path``, its network in evaluation mode.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: naming the file, what was expected and what came.
    """
    config = read_json(path / "config.json", _Config)
    tensors = read_tensors(path / "model.safetensors")
    network = _make(path, TransformerForDiffusion, config, "network")
    sampler = _make(path, Sampler, config, "schedule")
    vision = None if config.vision is None else _make(path, VisionEncoder, config, "vision")
    state_dim = network.cond_dim - (0 if vision is None else vision.feature_dim)
    where = path / "model.safetensors"
    _load(where, _NETWORK, tensors, network)
    if vision is not None:
        _load(where, _VISION, tensors, vision)
    normalizer_tensors = take(tensors, _NORMALIZER)
    expected = {
        f"{name}_{part}": (size,)
        for name, size in (("state", state_dim), ("action", network.input_dim))
        for part in ("scale", "offset")
    }
    check_tensors(f"{where}: {_NORMALIZER}", normalizer_tensors, expected)
    if tensors:
        raise ValueError(f"{where}: expected tensors of the policy alone, got {sorted(tensors)}")
    return StoredPolicy(network, Normalizer(**normalizer_tensors), sampler, vision, config.source or {})


def _load(where: Path, prefix: str, tensors: dict[str, Tensor], module: nn.Module) -> None:
    """Move the tensors under ``prefix`` into ``module`` and puts it in evaluation mode."""
    found = take(tensors, prefix)
    check_tensors(f"{where}: {prefix}", found, {k: tuple(v.shape) for k, v in module.state_dict().items()})
    module.load_state_dict({name: value.float() for name, value in found.items()})
    module.eval()


def _make(path: Path, kind: type[T], config: _Config, field: str) -> T:
    try:
        return kind(**getattr(config, field))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path / 'config.json'}: {field}: {error}") from error
