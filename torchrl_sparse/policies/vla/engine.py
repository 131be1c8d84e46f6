"""The table of a VLA's engines, and how a policy holds the one that it runs in."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from torchrl_sparse.blocks.engine.weights import WeightWatch
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.network import VLAEngine, VLANetwork
from torchrl_sparse.networks.vla.openvino import OpenVINOVLA, openvino_supports

__all__ = ["VLA_ENGINES", "RunsInEngine", "VLAEngineEntry", "VLAEngineSlot", "check_vla_engine"]


class VLAEngineEntry(NamedTuple):
    """An engine in :data:`VLA_ENGINES`.

    Attributes:
        make: makes it for a network, of the weights of the moment, and a number of threads; None is the network itself.
        applies: says whether it can run a network on this machine, and if not, why.
    """

    make: Callable[[VLANetwork, int], VLAEngine] | None
    applies: Callable[[VLANetwork], tuple[bool, str]]


# By name; "auto" takes the first that applies. "torch" is the network itself, which defines the answer.
VLA_ENGINES: dict[str, VLAEngineEntry] = {
    "openvino": VLAEngineEntry(OpenVINOVLA, openvino_supports),
    "torch": VLAEngineEntry(None, lambda network: (True, "")),
}


def check_vla_engine(name: str) -> None:
    """Raise InputError unless ``name`` is in :data:`VLA_ENGINES`, or ``"auto"``."""
    if name not in (names := ["auto", *VLA_ENGINES]):
        raise InputError(f"engine: expected one of {names}, got {name!r}")


class VLAEngineSlot:
    """Engine of a VLA, made on first use and again when weights or the number of threads change.

    Copies and pickles carry the choice, not the engine.

    Args:
        name: of the engine, or ``"auto"``.

    Raises:
        InputError: on an unknown name.
    """

    def __init__(self, name: str) -> None:
        check_vla_engine(name)
        self.name = name
        self._made: _Made | None = None

    def get(self, network: VLANetwork) -> VLAEngine:
        """Return the engine of ``network``, or the network itself if gradients or forward hooks are in use.

        Raises:
            InputError: if the chosen engine cannot run the network; the message says why.
        """
        made = self._made  # read and replaced in one go: other threads may do the same
        if made is None or not made.serves(network):
            make = VLA_ENGINES[self.choose(network)].make
            if make is None:
                return network
            self._made = made = _Made(network, make)
        return network if made.why_not() else made.engine()

    def choose(self, network: VLANetwork) -> str:
        """Return the name of the engine for ``network``.

        Raises:
            InputError: if the chosen one cannot run it; the message says why.
        """
        if self.name == "auto":
            return next(name for name, entry in VLA_ENGINES.items() if entry.applies(network)[0])
        applies, reason = VLA_ENGINES[self.name].applies(network)
        if not applies:
            raise InputError(f"{self.name} engine: {reason}")
        return self.name

    def describe(self, network: VLANetwork) -> str:
        """Describe the engine and its device; for ``"auto"``, also why faster engines were not used."""
        name, weight = self.choose(network), next(network.parameters())
        why_not = {}
        if self.name == "auto":
            names = list(VLA_ENGINES)
            why_not = {other: VLA_ENGINES[other].applies(network)[1] for other in names[: names.index(name)]}
        if (make := VLA_ENGINES[name].make) is not None and (reason := _Made(network, make).why_not()):
            why_not, name = {**why_not, name: reason}, "torch"
        kind = f"{str(weight.dtype).removeprefix('torch.')} on {weight.device}"
        text = f"{name}: {kind}, {torch.get_num_threads()} threads"
        return text + "".join(f" (not {other}: {reason})" for other, reason in why_not.items())

    def refresh(self) -> None:
        """Make the engine again in the next call, from the weights that the network has then."""
        self._made = None

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "_made": None}


class _Made:
    """An engine of a network, and the state of the world that it was made in."""

    def __init__(self, network: VLANetwork, make: Callable[[VLANetwork, int], VLAEngine]) -> None:
        self._watch, self._make = WeightWatch(network), make
        self._state = self._now()
        self._engine: VLAEngine | None = None
        self._gradients = any(weight.requires_grad for weight in network.parameters())
        modules = [*network.modules()]
        self._hooks = [part._forward_hooks for part in modules] + [
            part._forward_pre_hooks for part in modules
        ]

    def _now(self) -> tuple:
        # A process that was forked off has none of the engine's threads.
        return self._watch.state(), torch.get_num_threads(), os.getpid()

    def serves(self, network: VLANetwork) -> bool:
        """Return whether it was made for this network as it is now."""
        return self._watch.watches(network) and self._state == self._now()

    def why_not(self) -> str:
        """Return why this call has to run in the network itself, or nothing."""
        if self._gradients and torch.is_grad_enabled():
            return "gradients may be asked for"
        return "a module has forward hooks" if any(self._hooks) else ""

    def engine(self) -> VLAEngine:
        if self._engine is None:
            self._engine = self._make(self._watch.network, torch.get_num_threads())
        return self._engine


class RunsInEngine:
    """Part of a `VLAPolicy` that chooses and describes its engine."""

    network: VLANetwork
    _slot: VLAEngineSlot

    @property
    def engine(self) -> str:
        """The chosen engine; assign another name to change it."""
        return self._slot.name

    @engine.setter
    def engine(self, name: str) -> None:
        self._slot = VLAEngineSlot(name)

    def current_engine(self) -> VLAEngine:
        """Return the engine of the next call: the network itself or its compiled parts."""
        return self._slot.get(self.network)

    def engine_info(self) -> str:
        """Say which engine runs the network and on what, e.g. ``"openvino: float32 on cpu, 1 threads"``, and why ``"auto"`` had
        to do without a faster one. InputError if the chosen engine cannot run this network here.
        """
        return self._slot.describe(self.network)

    def refresh(self) -> None:
        """Read all weights again in the next call, after writes to them that `WeightWatch` does not see."""
        self._slot.refresh()
