"""Detection of changed network weights, cheap enough for every policy call.

A complete watch would read every weight: 36 MB for the published networks, more than a millisecond. Versions, addresses and
identities of parameters and modules show all that PyTorch records; the first values of each parameter are compared besides,
because diffusers' weight average writes through ``.data``, which leaves no record. That takes 0.16 ms, and 0.03 ms of frozen
weights, which cannot change, so that only their versions are compared (one core of an AMD EPYC without AVX-512, 2026-11-29).
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from itertools import chain
from operator import attrgetter
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.frozen import Frozen

__all__ = ["Members", "WeightWatch", "check_weights"]

_SAMPLES = 4
_VERSION = attrgetter("_version")


class WeightWatch:
    """Detector of changes in a network's weights.

    It sees optimiser steps, ``load_state_dict`` (with ``assign`` too), moves, and parameters or modules that were
    exchanged for others; of writes through ``parameter.data`` those that change one of the first values of a parameter.
    After any other write through ``.data``, call :meth:`refresh`.

    Args:
        network: whose parameters to watch.

    Examples:
        >>> network = nn.Linear(2, 2)
        >>> watch = WeightWatch(network)
        >>> before = watch.state()
        >>> watch.state() == before
        True
        >>> network.weight = nn.Parameter(network.weight.detach().clone())
        >>> watch.state() == before
        False
    """

    def __init__(self, network: nn.Module) -> None:
        self._network = weakref.ref(network)
        self._members = Members.of(network)
        self._places: tuple[list[int], Any] = ([], None)
        self._refreshed = 0
        self._frozen: tuple[Frozen | None, tuple] = (None, ())

    @property
    def network(self) -> nn.Module:
        """The watched network, held by a weak reference."""
        network = self._network()
        if network is None:
            raise ReferenceError("network: expected one that is still in use, it is gone")
        return network

    def watches(self, network: nn.Module) -> bool:
        """Tell whether this is the watched network; also works after that is gone."""
        return self._network() is network

    def refresh(self) -> None:
        """Make the next :meth:`state` differ from all earlier ones."""
        self._refreshed += 1

    def state(self) -> tuple:
        """Return a value that compares equal as long as the weights are the same.

        Raises:
            InputError: naming a weight that has no values, on the meta device, or that is no floating-point number.
            FrozenError: naming a frozen weight that was written through what was taken of it before.
        """
        frozen = Frozen.of(self.network)
        if frozen is None:
            return self._ask()
        frozen.check()
        known, state = self._frozen  # read and replaced in one go: other threads may do the same
        if known is not frozen:
            state = self._ask()
            self._frozen = frozen, state
        return state, self._refreshed

    def _ask(self) -> tuple:
        members = self._members
        if members.identities() != members.known:
            members = self._members = Members.of(self.network)
        # By `map`, which does not come back to the interpreter: all of this has left the caches since it was asked last.
        addresses = [*map(Tensor.data_ptr, members.parameters)]
        addresses += map(Tensor.is_contiguous, members.parameters)  # a matrix may be turned where it lies
        versions = [*map(_VERSION, members.counted)]
        known, places = self._places  # read and replaced in one go: other threads may do the same
        if known != addresses:
            check_weights(self.network)
            places = self.locate([_first_values(p.detach()) for p in members.parameters])
            self._places = addresses, places
        return members.known, addresses, versions, self.read(places), self._refreshed

    def locate(self, samples: list[Tensor]) -> Any:
        """Return what :meth:`read` needs to read ``samples``, views of each parameter's first values."""
        return samples

    def read(self, places: Any) -> Any:
        """Return the values at ``places`` in a form that compares equal bit by bit, NaN included."""
        return torch.cat(places).view(torch.uint8).cpu().numpy().tobytes()


@dataclass(frozen=True)
class Members:
    """The parameters and modules of a network at one time, kept alive so that no other object can reuse their ids."""

    holders: list[dict]
    held: list[list]
    known: list[int]
    parameters: list[nn.Parameter]
    counted: list[nn.Parameter]  # tensors made in inference mode count no versions

    @classmethod
    def of(cls, network: nn.Module) -> Members:
        holders = [holder for module in network.modules() for holder in (module._parameters, module._modules)]
        holders = [holder for holder in holders if holder]
        held = [list(holder.values()) for holder in holders]
        known = [id(member) for members in held for member in members]
        parameters = list(network.parameters())
        return cls(holders, held, known, parameters, [p for p in parameters if not p.is_inference()])

    def identities(self) -> list[int]:
        return [*map(id, chain.from_iterable(map(dict.values, self.holders)))]


def _first_values(weight: Tensor) -> Tensor:
    """Return a view of the first values in memory order, or of the first row where there is no such order."""
    flat = weight.view(-1) if weight.is_contiguous() else weight[(0,) * (weight.ndim - 1)]
    return flat[:_SAMPLES]


def check_weights(network: nn.Module) -> None:
    """Raise InputError, naming the weight, if a weight of ``network`` has no values or is not floating-point."""
    for name, parameter in network.named_parameters():
        if not parameter.is_floating_point():
            raise InputError(f"network: expected floating-point weights, got {name!r} of {parameter.dtype}")
        if parameter.is_meta:
            raise InputError(
                f"network: expected weights with values, got {name!r} on the meta device (move the network with "
                f"to_empty(), then load_state_dict())"
            )
