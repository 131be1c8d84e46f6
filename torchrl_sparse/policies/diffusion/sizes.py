"""Device and sizes of a policy, from its network and sampler."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import nn

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry, carried_keys
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer

__all__ = ["PolicySizes"]


class PolicySizes:
    """Mixin of `DiffusionPolicy` properties that follow from its parts."""

    module: nn.ModuleDict
    sampler: Sampler
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    @property
    def network(self) -> Denoiser:
        return self.module["denoise"].network

    @property
    def normalizer(self) -> Normalizer:
        return self.module["denoise"].normalizer

    @property
    def vision(self) -> VisionEncoder | None:
        """Camera encoder."""
        return self.module["encode"].condition.vision

    @property
    def device(self) -> torch.device:
        """Where the networks are, and policy calls and their noise must be; ``policy.to("cuda")`` moves it."""
        return self.network.like.device

    @property
    def n_obs_steps(self) -> int:
        """Observation steps To in the condition."""
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
        """Actions that the network denoises, H; a chunk omits those before the present step."""
        return self.network.horizon

    @property
    def chunk_shape(self) -> tuple[int, int]:
        """(n, A) of a chunk."""
        return self.horizon - self.n_obs_steps + 1, self.network.input_dim

    def set_keys(self, **names: NestedKey | None) -> None:
        """Rename the environment's keys, as TorchRL losses do.

        Args:
            names: ``state``, the environment's key, ``("observation", "state")`` where none is set. The policy reads its
                history, such as ``("history", "proprio")``, which `state_history` writes. Files do not keep names.

        Examples:
            >>> from torchrl_sparse import DiffusionPolicy
            >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
            >>> policy.set_keys(state=("observation", "proprio"))
            >>> policy.in_keys[0]
            ('history', 'proprio')
        """
        self.module["encode"].condition.set_keys(**names)
        self.sampler = self.sampler  # which lists the keys again

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the keys carried for one environment, see :mod:`torchrl_sparse.carried`."""
        frames = (self.n_obs_steps, 0 if self.vision is None else self.vision.feature_dim)
        known = {keys.FRAME_FEATURES: Entry(frames)}
        return {key: known[key] for key in carried_keys(self) if key in known}
