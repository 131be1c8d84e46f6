"""Low-rank adapters (LoRA, arXiv:2106.09685) of the decoder: the language model's own weights stay unchanged.

A product with W becomes one with W + up @ down, of which ``down`` [rank, in] and ``up`` [out, rank] alone are trained; ``up``
begins as zeros, so that nothing changes at first. To use a policy, `fold_adapters` adds them up: it then costs what any does.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.networks.sizes import check_size
from torchrl_sparse.networks.vla.network import VLANetwork

__all__ = ["AdaptedLinear", "add_adapters", "fold_adapters", "is_frozen"]

_FROZEN, _ADAPTERS = "decoder.llama.", (".down", ".up")
_MAX_RANK = 1 << 12


class AdaptedLinear(nn.Module):
    """A linear layer without bias: a frozen weight and a trained low-rank update.

    Args:
        linear: the layer.
        rank: of the adapter.

    Examples:
        >>> linear = nn.Linear(4, 6, bias=False)
        >>> adapted, x = AdaptedLinear(linear, rank=2), torch.ones(1, 4)
        >>> torch.equal(adapted(x), linear(x)), [n for n, p in adapted.named_parameters() if p.requires_grad]
        (True, ['down', 'up'])
    """

    def __init__(self, linear: nn.Linear, rank: int):
        super().__init__()
        self.weight = linear.weight.requires_grad_(False)
        self.down = nn.Parameter(torch.randn(rank, linear.in_features) * linear.in_features**-0.5)
        self.up = nn.Parameter(torch.zeros(linear.out_features, rank))

    def forward(self, x: Tensor) -> Tensor:
        """Return x [..., in] times the adapted weight, [..., out]."""
        learned = functional.linear(functional.linear(x, self.down), self.up)
        return functional.linear(x, self.weight) + learned

    @torch.no_grad()
    def folded(self) -> nn.Linear:
        """Return an equivalent plain linear layer."""
        linear = nn.Linear(self.weight.shape[1], self.weight.shape[0], bias=False, device="meta")
        linear.weight = nn.Parameter(self.weight + self.up @ self.down)
        return linear


def add_adapters(network: VLANetwork, rank: int) -> VLANetwork:
    """Add adapters to the linear layers of all decoder layers, in place, and freeze the rest of the decoder.

    Raises:
        InputError: if ``rank`` is no positive number, or far too large.
    """
    check_size("rank", rank, _MAX_RANK)
    network.decoder.llama.requires_grad_(False)
    for parent, name, linear in _layers(network, nn.Linear):
        setattr(parent, name, AdaptedLinear(linear, rank))
    return network


def fold_adapters(network: VLANetwork) -> VLANetwork:
    """Merge the adapters into the weights that they adapt, in place."""
    for parent, name, adapted in _layers(network, AdaptedLinear):
        setattr(parent, name, adapted.folded())
    return network


def is_frozen(name: str) -> bool:
    """Tell by its name whether a tensor of an adapted network belongs to the frozen language model.

    >>> [is_frozen(f"decoder.llama.layers.0.mlp.up_proj.{name}") for name in ("weight", "up")], is_frozen("head.fc1.weight")
    ([True, False], False)
    """
    return name.startswith(_FROZEN) and not name.endswith(_ADAPTERS)


def _layers(network: VLANetwork, kind: type) -> Iterator[tuple[nn.Module, str, nn.Module]]:
    """Return the layers of a kind in the decoder: what holds it, its name there, and itself."""
    parents = [*network.decoder.llama.layers.modules()]
    return ((p, name, part) for p in parents for name, part in [*p.named_children()] if type(part) is kind)
