"""Times of the stages of a diffusion policy call: cameras and planner beside the denoiser."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.factory import EngineName
from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.engine_cases import make_network
from torchrl_sparse.evaluation.latency.measure import measure_latency
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["example_query", "image_policy", "stage_seconds", "untrained_policy"]

_CAMERAS, _IMAGE = ("image", "wrist_image"), 84


def untrained_policy(shape: str, *, engine: EngineName = "auto") -> DiffusionPolicy:
    """Make an untrained policy of a published shape, see `make_network`; the shape ``"image"`` has two cameras.

    Raises:
        InputError: on an unknown shape.
    """
    network = make_network(shape)
    if shape == "image":
        return image_policy(network, engine=engine)
    return DiffusionPolicy(network, _identity(network, network.cond_dim), engine=engine)


def image_policy(
    network: TransformerForDiffusion,
    *,
    width: int = 64,
    sampler: Sampler | None = None,
    engine: EngineName = "auto",
) -> DiffusionPolicy:
    """Put the published two-camera encoder, untrained, before a denoiser conditioned on its features and a state.

    Args:
        network: the denoiser, on the device that is to run everything.
        width: of the encoder's first stage; 64 is a ResNet-18.
        sampler: of the policy, whose training steps others of it have too; 100 of DDPM without it.
        engine: that runs the denoiser.

    Raises:
        InputError: if the condition has no room for the features.
    """
    vision = VisionEncoder(_CAMERAS, image_size=(_IMAGE, _IMAGE), width=width)
    state = network.cond_dim - vision.feature_dim
    if state < 1:
        raise InputError(
            f"cond_dim: expected more than the features' {vision.feature_dim}, got {network.cond_dim}"
        )
    parts = {"vision": vision, "sampler": sampler, "engine": engine}
    policy = DiffusionPolicy(network, _identity(network, state), **parts)
    return policy.to(network.like.device)


def _identity(network: TransformerForDiffusion, state_dim: int) -> Normalizer:
    one, zero = torch.ones, torch.zeros
    return Normalizer(one(state_dim), zero(state_dim), one(network.input_dim), zero(network.input_dim))


def example_query(policy: DiffusionPolicy, batch: int = 1) -> TensorDict:
    """Return example observations [batch] of a policy: zero states, noise images, and noise seeds.

    A policy that begins from its last chunk finds one that is a step old, as in the midst of an episode.
    """
    steps = policy.n_obs_steps
    history = {"state": torch.zeros(batch, steps, len(policy.normalizer.state_scale))}
    if policy.vision is not None:
        shape = (batch, steps, 3, *policy.vision.image_size)
        generator = torch.Generator().manual_seed(0)
        for name in policy.vision.cameras:
            history[name] = torch.randint(256, shape, generator=generator, dtype=torch.uint8)
    episode = {"seed": torch.ones(batch, 1, dtype=torch.long), "step": torch.ones(batch, 1, dtype=torch.long)}
    query = TensorDict({"history": history, "episode": episode}, [batch])
    if keys.LAST_CHUNK in policy.in_keys:
        query[keys.LAST_CHUNK] = torch.zeros(batch, *policy.chunk_shape)
        query[keys.ELAPSED] = torch.ones(batch, 1, dtype=torch.long)
    return query.to(policy.device)


@torch.no_grad()
def stage_seconds(
    policy: DiffusionPolicy, query: TensorDictBase, repeats: int, warmup: int = 1
) -> dict[str, float]:
    """Measure the median seconds of a whole policy call and of its stages, interleaved.

    Returns:
        ``"query"``, the whole of it; ``"encode"``, of which, with cameras, ``"pixels"`` (crop and units of all images) and, by
        camera, ``"camera <name>"`` (its network) are parts; ``"plan"``, of an observation-conditioned planner;
        ``"denoise"``, with all its steps; ``"rest"``, what is none of these: keys and Python. With cameras, ``"encode, plain"``
        is what their networks take on weights that are not packed, for comparison.
    """
    stages, vision = dict(policy.module.items()), policy.vision
    answered = policy(query.copy())
    calls: dict[str, Callable[[], Any]] = {
        "query": lambda: policy(query.copy()),
        "encode": lambda: stages["encode"](query.copy()),
    }
    if vision is not None:
        images = {name: query["history", name].flatten(0, 1) for name in vision.cameras}
        used = stages["encode"].condition.cameras.get(vision, policy.n_obs_steps)
        calls["pixels"] = lambda: [used.encoders[name].pixels(images[name]) for name in vision.cameras]
        calls |= {f"camera {name}": partial(used.encoders[name], images[name]) for name in vision.cameras}
    if not policy.plan.is_static:
        calls["plan"] = lambda: stages["plan"](answered.copy())
    calls["denoise"] = lambda: stages["denoise"](answered.copy())
    if vision is not None:
        calls["encode, plain"] = lambda: vision(images)
    latency = measure_latency(calls, repeats, warmup, device=policy.device)
    seconds = {name: found.p50 for name, found in latency.items()}
    plain = {"encode, plain": seconds.pop("encode, plain")} if vision is not None else {}
    parts = sum(seconds.get(name, 0.0) for name in ("encode", "plan", "denoise"))
    return seconds | {"rest": seconds["query"] - parts} | plain
