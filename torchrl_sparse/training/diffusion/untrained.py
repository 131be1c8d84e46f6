"""Construction of an untrained diffusion policy that fits the demonstrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["untrained_policy"]


def untrained_policy(
    demos: Demonstrations,
    sizes: Mapping[str, Any],
    *,
    poses: bool,
    state_mode: str | None = None,
    cameras: Sequence[str] = (),
    crop: float = 0.905,
    width: int = 64,
    seed: int = 0,
) -> DiffusionPolicy:
    """Return an untrained policy with the demonstrations' inputs, outputs and normaliser.

    Args:
        demos: decide the sizes of state, action and images, and the normaliser.
        sizes: arguments of `TransformerForDiffusion` that demonstrations do not decide.
        poses: whether actions are absolute poses of arms.
        state_mode: see `Normalizer.fit`; None is as published: "global" with poses, else "range".
        cameras: names of the images that the policy observes.
        crop: share of an image's height and width that is cropped.
        width: channels of the first stage of a camera's encoder.
        seed: of the weights.
    """
    state, action = demos.data[keys.STATE], demos.data[keys.ACTION]
    state_mode = state_mode or ("global" if poses else "range")
    normalizer = Normalizer.fit(state, action, state_mode=state_mode, poses=poses)
    torch.manual_seed(seed)
    vision = None
    if cameras:
        image_size = demos.data["observation", cameras[0]].shape[-2:]
        crop_size = [round(crop * size) for size in image_size]
        vision = VisionEncoder(list(cameras), image_size=image_size, crop_size=crop_size, width=width)
    network = TransformerForDiffusion(
        input_dim=action.shape[-1],
        output_dim=action.shape[-1],
        cond_dim=(0 if vision is None else vision.feature_dim) + state.shape[-1],
        **sizes,
    )
    return DiffusionPolicy(network, normalizer, vision=vision, engine="reference")
