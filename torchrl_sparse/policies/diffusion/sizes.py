"""Where a policy is and how large: what its network and its sampler say."""

from __future__ import annotations

import torch

from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["PolicySizes"]


class PolicySizes:
    """Properties of a `DiffusionPolicy` that follow from its network and its sampler."""

    network: TransformerForDiffusion
    sampler: Sampler

    @property
    def device(self) -> torch.device:
        """Where the networks are, and queries and their noise must be; ``policy.to("cuda")`` moves it."""
        return self.network.pos_emb.device

    @property
    def n_obs_steps(self) -> int:
        """Observation steps To that the condition holds."""
        return self.network.n_obs_steps

    @property
    def num_inference_steps(self) -> int:
        """Denoising steps K."""
        return self.sampler.num_inference_steps

    @property
    def num_blocks(self) -> int:
        """Blocks of a denoising step, 3L."""
        return self.network.num_blocks

    @property
    def horizon(self) -> int:
        """Actions that the network denoises, H; a chunk leaves out those before the present step."""
        return self.network.horizon
