"""How large a query and an answer of a VLA are: what its network and its pruner say."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import NestedKey

from torchrl_sparse.carried import Entry, make_primer
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.tokens.base import TokenPruner

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

__all__ = ["VLASizes"]


class VLASizes:
    """Properties of a `VLAPolicy` that follow from its network and its pruner."""

    network: VLANetwork
    pruner: TokenPruner | None

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
        """Return what the pruner carries of one environment, see :mod:`torchrl_sparse.carried`."""
        return {} if self.pruner is None else self.pruner.carried(chunk)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Return the transform that gives what the pruner carries from query to query its place in an environment's spec.

        For a policy without an executor, whose chunks TorchRL's `MultiAction` plays. Collectors append it by themselves with
        ``auto_register_policy_transforms=True``.

        Examples:
            >>> from torchrl_sparse import FrameDifferencePruner, VLAConfig, VLAPolicy
            >>> policy = VLAPolicy(VLANetwork(VLAConfig.tiny())).with_pruner(FrameDifferencePruner(0.5))
            >>> list(policy.make_tensordict_primer().primers.keys(True, True))
            [('tokens', 'frames')]
        """
        return make_primer(self.carried(None))
