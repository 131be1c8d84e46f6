"""Encoding of demonstration windows as a policy network's condition."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy

__all__ = ["encode_windows"]

_ENCODE_BATCH = 64  # windows whose images are in memory as floats at a time


@torch.no_grad()
def encode_windows(policy: DiffusionPolicy, windows: TensorDict) -> Tensor:
    """Return the condition f32 [B, To, D] of windows [B] from `Demonstrations.windows`, on the policy's device."""
    condition = policy.module["encode"].condition
    return torch.cat([condition(part.to(policy.device)) for part in windows.split(_ENCODE_BATCH)])
