"""Whole queries of a policy of images, part by part: what cameras cost beside the denoiser."""

from __future__ import annotations

import statistics

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.clock import synchronised_clock

__all__ = ["image_policy", "image_query", "stage_seconds"]

_CAMERAS, _IMAGE = ("image", "wrist_image"), 84


def image_policy(network: TransformerForDiffusion, *, width: int = 64) -> DiffusionPolicy:
    """Put the published encoder of two cameras, untrained, before a denoiser whose condition is their features and a state.

    Args:
        network: the denoiser, on the device that is to run everything.
        width: of the encoder's first stage; 64 is a ResNet-18.

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
    return DiffusionPolicy(network, Normalizer(one, zero, *action), vision=vision).to(network.pos_emb.device)


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
def stage_seconds(policy: DiffusionPolicy, query: TensorDictBase, repeats: int) -> dict[str, float]:
    """Measure the median seconds of ``"encode"``, ``"plan"`` and ``"denoise"`` within a query, after one that warms up."""
    device = policy.network.pos_emb.device
    # a cold start has no out_keys and does nothing
    stages = {name: stage for name, stage in policy.module.items() if stage.out_keys}
    samples: dict[str, list[float]] = {name: [] for name in stages}
    for _ in range(repeats + 1):
        data = query.copy()
        for name, stage in stages.items():
            start = synchronised_clock(device)
            stage(data)
            samples[name].append(synchronised_clock(device) - start)
    return {name: statistics.median(seconds[1:]) for name, seconds in samples.items()}
