"""Trainable pruning gates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from torchrl_sparse.blocks.l2c import StaticGates
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["GATES", "Gates", "make_gates"]


class Gates(Protocol):
    """Module whose logits are positive where pruning is preferred.

    Attributes:
        rate_input: whether the target prune rate is an input.
        is_static: whether they decide the same for every observation.
    """

    rate_input: bool
    is_static: bool

    def prune_logits(self, cond: Tensor, rate: Tensor | None = None) -> Tensor:
        """Return f32 [B, K, 3L] for encoded observations f32 [B, To, D] and, if used, rates f32 [B, 1]."""
        ...


def _sag(policy: DiffusionPolicy, rate_input: bool, *, reads: str = "all", **sizes: Any) -> PrunerNetwork:
    if reads not in ("all", "state"):
        raise InputError(f"reads: expected 'all' or 'state', got {reads!r}")
    features = 0 if policy.vision is None else policy.vision.feature_dim
    sampler = policy.sampler
    # Coordinates are whole numbers that fall toward the clean sample; times of flow are neither.
    flow = sampler.kind == "flow"
    falling = range(sampler.num_inference_steps)[::-1] if flow else sampler.timesteps.tolist()
    return PrunerNetwork(
        falling,
        policy.num_blocks,
        (policy.n_obs_steps, policy.network.cond_dim),
        rate_input=rate_input,
        unseen=features if reads == "state" else 0,
        **sizes,
    )


def _l2c(policy: DiffusionPolicy, rate_input: bool, **sizes: Any) -> StaticGates:
    if sizes:
        raise InputError(f"network: expected nothing of l2c, which has no network, got {', '.join(sizes)}")
    return StaticGates(policy.num_inference_steps, policy.num_blocks)


GATES: dict[str, Callable[..., nn.Module]] = {"sag": _sag, "l2c": _l2c}
"""Method -> function of (policy, rate_input, **sizes) that makes its `Gates`."""


def make_gates(
    method: str, policy: DiffusionPolicy, *, rate_input: bool = False, seed: int = 0, **sizes: Any
) -> nn.Module:
    """Return untrained gates for a policy, on its device.

    Args:
        method: a key of `GATES`: ``"sag"``, which reads the observation, or ``"l2c"``, which does not.
        policy: the policy, with the sampler that will be pruned.
        rate_input: whether SAG's pruner takes the target prune rate as an input.
        seed: of the weights.
        sizes: of the pruner, see `PrunerNetwork`; and ``reads``, ``"all"`` that the denoiser is conditioned on or ``"state"``,
            nothing of the cameras.

    Raises:
        InputError: for another method, something else to read, or sizes of L2C's gates, which have none.

    Examples:
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> gates = make_gates("sag", policy)
        >>> gates.prune_logits(torch.zeros(2, policy.n_obs_steps, policy.network.cond_dim)).shape
        torch.Size([2, 100, 24])
    """
    if method not in GATES:
        raise InputError(f"method: expected one of {', '.join(GATES)}, got {method!r}")
    torch.manual_seed(seed)
    return GATES[method](policy, rate_input, **sizes).to(policy.device)
