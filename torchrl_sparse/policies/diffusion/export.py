"""The parts of a policy as one file that C runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.blocks.engine.native.engine import native_supports
from torchrl_sparse.blocks.engine.native.packing import PackedNetwork, weight_type
from torchrl_sparse.blocks.engine.native.pruner import MAX_HIDDEN, NativePruner
from torchrl_sparse.blocks.engine.native.tsp import ExportedPlan, write_tsp
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag.planner import SAGPruner
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer

__all__ = ["export_policy"]


def export_policy(
    path: Path,
    network: TransformerForDiffusion,
    normalizer: Normalizer,
    sampler: Sampler,
    plan: Planner,
    *,
    weights: str,
    facts: dict[str, Any],
) -> None:
    """Write the file of :meth:`DiffusionPolicy.export`; ``facts`` about the policy go into its description."""
    supported, reason = native_supports(network)
    if not supported:
        raise ValueError(f"export: {reason}")
    if network.horizon < network.n_obs_steps:
        raise ValueError(
            f"export: expected horizon >= n_obs_steps, got {network.horizon} and {network.n_obs_steps}"
        )
    with torch.no_grad():
        exported = _exported_plan(plan, network)
        packed = PackedNetwork(network, sampler, weight_type(weights))
    parts = ("state_scale", "state_offset", "action_scale", "action_offset")
    description = {
        "format": "tsp/1",
        **facts,
        "sampler": sampler.config,
        "planner": type(plan).__name__,
        "weights": weights,
    }
    vectors = [getattr(normalizer, part) for part in parts]
    write_tsp(path, packed, vectors, exported, json.dumps(description))


def _exported_plan(plan: Planner, network: TransformerForDiffusion) -> ExportedPlan:
    slots = num_buffers(plan.reuse, network.num_blocks)
    if plan.is_static:
        mask = plan.masks(torch.zeros(1, network.n_obs_steps, network.cond_dim))[0]
        return ExportedPlan(slots, mask if mask.any() else None)
    if not isinstance(plan, SAGPruner):
        raise ValueError(
            f"plan: expected one that does not look at the observation, or a SAGPruner, got {type(plan).__name__}"
        )
    if plan.network.fuse_obs.out_features > MAX_HIDDEN:
        raise ValueError(
            f"plan: expected at most {MAX_HIDDEN} hidden activations, got {plan.network.fuse_obs.out_features}"
        )
    rate = plan.rate if plan.network.rate_input else None
    return ExportedPlan(slots, pruner=NativePruner(plan.network.mlp_weights()), rate=rate)
