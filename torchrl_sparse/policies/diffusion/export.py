"""Export of a policy to one file that robots run through the C interface ``tsp.h``, without Python or PyTorch.

The file holds network, normaliser, sampler and planner. Its actions equal the policy's with ``noise = "philox"``, to the last
bit on a CPU with the same instruction set.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.blocks.engine.native.packing import PackedNetwork, PackedWeights, weight_type
from torchrl_sparse.blocks.engine.native.pruner import MAX_HIDDEN, NativePruner
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.engine.native.tsp import ExportedPlan, write_tsp
from torchrl_sparse.blocks.mask import num_buffers
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.blocks.sag.planner import SAGPruner
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.policies.diffusion.denoiser import ActionDenoiser
from torchrl_sparse.policies.diffusion.encoder import ObservationEncoder
from torchrl_sparse.policies.diffusion.warm_start import QueryStart

__all__ = ["export_policy"]


def export_policy(
    path: Path,
    encode: ObservationEncoder,
    start: QueryStart,
    plan: Planner,
    denoise: ActionDenoiser,
    *,
    weights: str,
    facts: dict[str, Any],
) -> None:
    """Write a policy's stages to one file; ``policy.export(path)`` calls this.

    Args:
        path: of the file, e.g. ``"lift.tsp"``.
        encode, start, plan, denoise: the stages.
        weights: see `torchrl_sparse.blocks.engine.NativeEngine`.
        facts: about the policy, for the file's description.

    Raises:
        InputError: naming what cannot be exported: cameras, a warm start, a network that the native engine does not run, or a
            observation-conditioned planner of one's own.

    Examples:
        >>> import tempfile
        >>> from torchrl_sparse import DiffusionPolicy, Sampler
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddim", timesteps=[87, 20])
        >>> policy.export(Path(tempfile.mkdtemp()) / "lift.tsp")
    """
    network, normalizer, sampler = denoise.network, denoise.normalizer, denoise.sampler
    if (vision := encode.condition.vision) is not None:
        raise InputError(f"export: expected a policy of states, got cameras {list(vision.cameras)}")
    if start.name:
        raise InputError(f"start: expected policy calls that begin from noise, got {start.name}")
    supported, reason = native_supports(network)
    if not supported:
        raise InputError(f"export: {reason}")
    if not (sampler.coefficients.sample_share and math.isfinite(sampler.coefficients.clip)):
        raise InputError(f"sampler: expected one of clipped noise predictions in a file, got {sampler!r}")
    if weights == "int8":
        raise InputError("weights: expected one of ['float32', 'float16', 'bfloat16'] in a file, got 'int8'")
    if network.horizon < network.n_obs_steps:
        raise InputError(
            f"export: expected horizon >= n_obs_steps, got {network.horizon} and {network.n_obs_steps}"
        )
    with torch.no_grad():
        exported = _exported_plan(plan, network)
        packed = PackedNetwork(network, sampler, PackedWeights(network, weight_type(weights), narrow=False))
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
        raise InputError(
            f"plan: expected one that ignores the observation, or a SAGPruner, got {type(plan).__name__}"
        )
    if plan.network.fuse_obs.out_features > MAX_HIDDEN:
        raise InputError(
            f"plan: expected at most {MAX_HIDDEN} hidden activations, got {plan.network.fuse_obs.out_features}"
        )
    rate = plan.rate if plan.network.rate_input else None
    return ExportedPlan(slots, pruner=NativePruner(plan.network.mlp_weights()), rate=rate)
