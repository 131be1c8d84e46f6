"""Sizes of a VLA policy's inputs and outputs, from its network and its pruner."""

from __future__ import annotations

from tensordict import NestedKey

from torchrl_sparse.carried import Entry
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.tokens.base import TokenPruner

__all__ = ["VLASizes"]


class VLASizes:
    """Mixin of `VLAPolicy` properties that follow from its network and its pruner."""

    network: VLANetwork
    pruner: TokenPruner | None
    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    n_obs_steps = 1
    num_inference_steps = 1

    @property
    def horizon(self) -> int:
        """Actions of a chunk."""
        return self.network.config.chunk_size

    @property
    def chunk_shape(self) -> tuple[int, int]:
        """(n, A) of a chunk."""
        return self.horizon, self.network.config.action_dim

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the keys that the pruner carries for one environment, see :mod:`torchrl_sparse.carried`."""
        return {} if self.pruner is None else self.pruner.carried(chunk)
