"""Whole queries of a policy of images, part by part: what cameras cost beside the denoiser."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_sparse.evaluation.latency.measure import measure_latency
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["image_policy", "image_query", "image_query_seconds"]

_CAMERAS, _IMAGE = ("image", "wrist_image"), 84


def image_policy(
    network: TransformerForDiffusion, *, width: int = 64, sampler: Sampler | None = None
) -> DiffusionPolicy:
    """Put the published encoder of two cameras, untrained, before a denoiser whose condition is their features and a state.

    Args:
        network: the denoiser, on the device that is to run everything.
        width: of the encoder's first stage; 64 is a ResNet-18.
        sampler: of the policy, whose training steps others of it have too; 100 of DDPM without it.

    Raises:
        ValueError: if the condition has no room for the features.
    """
    vision = VisionEncoder(_CAMERAS, image_size=(_IMAGE, _IMAGE), width=width)
    state = network.cond_dim - vision.feature_dim
    if state < 1:
        raise ValueError(
            f"cond_dim: expected more than the features' {vision.feature_dim}, got {network.cond_dim}"
        )
    one, zero = torch.ones(state), torch.zeros(state)
    action = torch.ones(network.input_dim), torch.zeros(network.input_dim)
    policy = DiffusionPolicy(network, Normalizer(one, zero, *action), vision=vision, sampler=sampler)
    return policy.to(network.pos_emb.device)


def image_query(policy: DiffusionPolicy, batch: int) -> TensorDict:
    """Return random observations [batch] of an :func:`image_policy`, with the seeds of their noise."""
    device, steps = policy.network.pos_emb.device, policy.n_obs_steps
    history = {
        name: torch.randint(256, (batch, steps, 3, _IMAGE, _IMAGE), dtype=torch.uint8) for name in _CAMERAS
    }
    history["state"] = torch.rand(batch, steps, len(policy.normalizer.state_scale))
    episode = {"seed": torch.ones(batch, 1, dtype=torch.long), "step": torch.arange(batch)[:, None]}
    return TensorDict({"history": history, "episode": episode}, [batch]).to(device)


@torch.no_grad()
def image_query_seconds(
    policy: DiffusionPolicy, query: TensorDictBase, repeats: int, warmup: int = 1
) -> dict[str, float]:
    """Measure the median seconds of a whole query of images, and of what happens in it, interleaved.

    Returns:
        ``"query"``, the whole of it; ``"encode"``, of which ``"pixels"`` (crop and units of all images) and, by camera,
        ``"camera <name>"`` (its network) are parts; ``"denoise"``, with all its steps; ``"rest"``, what is neither encoding
        nor denoising: the plan, keys and Python. ``"encode, plain"`` is what the cameras' networks take on weights that are
        not packed, for comparison.
    """
    stages, vision = dict(policy.module.items()), policy.vision
    encoded = policy(query.copy())
    images = {name: query["history", name].flatten(0, 1) for name in vision.cameras}
    used = stages["encode"].condition.cameras.get(vision, policy.n_obs_steps)
    calls: dict[str, Callable[[], Any]] = {
        "query": lambda: policy(query.copy()),
        "encode": lambda: stages["encode"](query.copy()),
        "pixels": lambda: [used.encoders[name].pixels(images[name]) for name in vision.cameras],
        **{f"camera {name}": partial(used.encoders[name], images[name]) for name in vision.cameras},
        "denoise": lambda: stages["denoise"](encoded.copy()),
        "encode, plain": lambda: vision(images),
    }
    latency = measure_latency(calls, repeats, warmup, device=policy.device)
    seconds = {name: found.p50 for name, found in latency.items()}
    plain = {"encode, plain": seconds.pop("encode, plain")}
    return seconds | {"rest": seconds["query"] - seconds["encode"] - seconds["denoise"]} | plain
