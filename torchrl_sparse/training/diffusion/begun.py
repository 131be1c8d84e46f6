"""Further training of a trained diffusion policy; options that conflict with it are refused, except dropout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_sparse.envs.contract import continued_source, policy_contract
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["begun_policy", "continued_policy"]

_DROPOUT = ("p_drop_emb", "p_drop_attn")


def begun_policy(
    path: str | Path,
    sizes: Mapping[str, Any],
    *,
    state_mode: str | None = None,
    crop: float | None = None,
    width: int | None = None,
) -> DiffusionPolicy:
    """Read a policy for further training, with its weights, sizes, normaliser, sampler and source, but without its planner.

    Args:
        path: see `DiffusionPolicy.from_pretrained`.
        sizes: arguments of `TransformerForDiffusion` that are asked for, None for the policy's own. Dropout, on which no weight
            depends, is set to the requested value.
        state_mode, crop, width: as of `untrained_policy`; None for the policy's own.

    Raises:
        FileNotFoundError, InputError: as `DiffusionPolicy.from_pretrained`; and naming what is asked for that it has not.
    """
    policy = DiffusionPolicy.from_pretrained(path, engine="reference")
    network = policy.network
    asked = {name: value for name, value in sizes.items() if value is not None}
    dropout = {name: asked.pop(name) for name in _DROPOUT if name in asked}
    for name, value in asked.items():
        _check(f"network.{name}", value, network.config[name], path)
    _check("state_normalization", state_mode, _state_mode(policy.normalizer), path)
    vision = None if policy.vision is None else policy.vision.config
    _check("vision.width", width, vision and vision["width"], path)
    _check("vision.crop", crop, vision and _own_crop(vision, crop), path)
    if dropout:
        network = TransformerForDiffusion(**network.config | dropout)
        network.load_state_dict(policy.network.state_dict())
    shared = {"vision": policy.vision, "sampler": policy.sampler, "engine": "reference"}
    begun = DiffusionPolicy(network, policy.normalizer, **shared)
    begun.source = policy.source
    return begun


def continued_policy(
    path: str | Path, task: str, cameras: Mapping[str, str], sizes: Mapping[str, Any], **asked: Any
) -> DiffusionPolicy:
    """Read a policy for further training on a task of the library, which its ``source`` then names.

    Args:
        path, sizes, asked: see `begun_policy`.
        task: a name or alias.
        cameras: image -> camera of the demonstrations; they have to be the policy's.

    Raises:
        FileNotFoundError, InputError: as `begun_policy` and `continued_source`; and naming a camera that is not the policy's.
    """
    policy = begun_policy(path, sizes, **asked)
    if policy.vision is not None:
        policy.source = {"cameras": dict(cameras)} | policy.source
    policy.source = continued_source(task, policy)
    own = policy_contract(task, policy).cameras
    for name, key in cameras.items():
        _check(f"cameras.{name}", key, own.get(name), path)
    return policy


def _check(option: str, asked: Any, own: Any, path: str | Path) -> None:
    if asked is not None and asked != own:
        raise InputError(f"{option}: expected {own}, as of the policy in {path}, got {asked}")


def _own_crop(vision: Mapping[str, Any], asked: float | None) -> float:
    """Return the share that is cropped: ``asked`` if that is as many pixels."""
    pixels, size = list(vision["crop_size"]), list(vision["image_size"])
    same = asked is not None and [round(asked * side) for side in size] == pixels
    return asked if same else round(pixels[0] / size[0], 3)


def _state_mode(normalizer: Normalizer) -> str:
    """Tell how states are normalised, see `Normalizer.fit`."""
    one_scale = normalizer.state_scale.unique().numel() <= 1 and not normalizer.state_offset.any()
    return "global" if one_scale else "range"
