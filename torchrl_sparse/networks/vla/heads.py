"""OpenVLA-OFT's additions to OpenVLA (arXiv:2502.19645): a proprioception token and an L1 regression head for chunks."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.networks.vla.config import VLAConfig

__all__ = ["L1ActionHead", "ProprioProjector"]


class ProprioProjector(nn.Module):
    """Projector of the normalised state to one decoder token."""

    def __init__(self, config: VLAConfig):
        super().__init__()
        self.fc1 = nn.Linear(config.state_dim, config.llm.dim)
        self.fc2 = nn.Linear(config.llm.dim, config.llm.dim)

    def forward(self, state: Tensor) -> Tensor:
        """Project states [B, state_dim] to [B, llm.dim]."""
        return self.fc2(functional.gelu(self.fc1(state)))


class L1ActionHead(nn.Module):
    """Regressor of normalised actions from decoder outputs: one residual network for all actions of the chunk.

    The A read-outs of an action are concatenated.
    """

    def __init__(self, config: VLAConfig):
        super().__init__()
        width = config.llm.dim
        self.chunk_size, self.action_dim = config.chunk_size, config.action_dim
        self.layer_norm1 = nn.LayerNorm(config.action_dim * width)
        self.fc1 = nn.Linear(config.action_dim * width, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU()) for _ in range(2)
        )
        self.layer_norm2 = nn.LayerNorm(width)
        self.fc2 = nn.Linear(width, config.action_dim)

    def forward(self, readout: Tensor) -> Tensor:
        """Return the actions [B, H, A] for decoder outputs [B, H * A, llm.dim]."""
        x = readout.unflatten(1, (self.chunk_size, -1)).flatten(2)
        x = functional.relu(self.fc1(self.layer_norm1(x)))
        for block in self.blocks:
            x = x + block(x)
        return self.fc2(self.layer_norm2(x))
