"""Noticing that a network's weights have changed, cheaply enough to ask in every query."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["WeightWatch"]

_SAMPLES = 4


class WeightWatch:
    """Tells the weights of a network apart over time.

    Optimisers and ``load_state_dict`` count up a parameter's version and moving it changes its address.
    Writing through ``parameter.data``, as diffusers' weight average does, leaves no such trace, so a few
    values of each parameter are compared as well. Parameter objects that are exchanged for others are not
    seen.

    Args:
        network: whose parameters to watch.

    Examples:
        >>> network = nn.Linear(2, 2)
        >>> watch = WeightWatch(network)
        >>> before = watch.state()
        >>> watch.state() == before
        True
        >>> _ = network.weight.data.add_(1)
        >>> watch.state() == before
        False
    """

    def __init__(self, network: nn.Module) -> None:
        self._parameters = list(network.parameters())
        self._places: tuple[list[int], Any] = ([], None)

    def state(self) -> tuple:
        """Compares equal as long as the weights are the same."""
        addresses = [p.data_ptr() for p in self._parameters]
        # Tensors made in inference mode count no versions.
        versions = [0 if p.is_inference() else p._version for p in self._parameters]
        known, places = self._places  # read and replaced in one go: other threads may do the same
        if known != addresses:
            places = self.locate([p.detach().view(-1)[:_SAMPLES] for p in self._parameters])
            self._places = addresses, places
        return addresses, versions, self.read(places)

    def locate(self, samples: list[Tensor]) -> Any:
        """What :meth:`read` needs to read ``samples``, views of each parameter's first values."""
        return samples

    def read(self, places: Any) -> Any:
        """The values at ``places``, as something that compares."""
        return torch.cat(places).tolist()
