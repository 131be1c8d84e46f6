"""The table of engines, and the slot in which a policy holds its engine."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from torchrl_sparse.blocks.engine.base import Engine
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.engine.reference import ReferenceEngine
from torchrl_sparse.blocks.engine.torch.adaln_engine import AdaLNEngine
from torchrl_sparse.blocks.engine.torch.engine import TorchEngine
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["ENGINES", "EngineEntry", "EngineName", "EngineSlot", "check_engine", "make_engine"]

EngineName = str  # a name in ENGINES, or "auto"
Applies = Callable[[Denoiser], tuple[bool, str]]


def _always(network: Denoiser) -> tuple[bool, str]:
    return True, ""


def _torch_engine(network: Denoiser, sampler: Sampler) -> Engine:
    """Make the PyTorch engine of the network's shape."""
    if isinstance(network, AdaLNTransformer):
        return AdaLNEngine(network, sampler)
    assert isinstance(network, TransformerForDiffusion)  # there is no other
    return TorchEngine(network, sampler)


class EngineEntry(NamedTuple):
    """An engine in :data:`ENGINES`.

    Attributes:
        make: makes it for a network and a sampler; raises InputError where it does not apply.
        applies: says whether it can run a network on this machine, and if not, why.

    Examples:
        >>> ENGINES["mine"] = EngineEntry(ReferenceEngine)  # any class that offers what `Engine` says
        >>> "mine" in ENGINES
        True
        >>> del ENGINES["mine"]
    """

    make: Callable[[Denoiser, Sampler], Engine]
    applies: Applies = _always


# By name; "auto" takes the first that applies, so that those that round come last.
ENGINES: dict[str, EngineEntry] = {
    "native": EngineEntry(NativeEngine, native_supports),
    "torch": EngineEntry(_torch_engine),
    "reference": EngineEntry(ReferenceEngine),
    "native_bf16": EngineEntry(partial(NativeEngine, weights="bfloat16"), native_supports),
    "native_int8": EngineEntry(partial(NativeEngine, weights="int8"), native_supports),
}


def check_engine(name: str) -> None:
    """Raise InputError unless ``name`` is in :data:`ENGINES`, or ``"auto"``."""
    names = ["auto", *ENGINES]
    if name not in names:
        raise InputError(f"engine: expected one of {names}, got {name!r}")


def make_engine(name: EngineName, network: Denoiser, sampler: Sampler) -> Engine:
    """Make the engine ``name`` for ``network`` and ``sampler``.

    ``"auto"`` takes the first of :data:`ENGINES` that applies: native on a CPU where it was built, else torch.

    Raises:
        InputError: on an unknown name, or if the engine cannot run the network here; the message says why.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> make_engine("torch", network, Sampler("ddim", 10)).name
        'torch'
    """
    check_engine(name)
    if name == "auto":
        name = next(name for name, entry in ENGINES.items() if entry.applies(network)[0])
    applies, reason = ENGINES[name].applies(network)
    if not applies:
        raise InputError(f"{name} engine: {reason}")
    return ENGINES[name].make(network, sampler)


class EngineSlot:
    """Engine of a policy, made on first use and again after a change of sampler or device.

    Copies and pickles carry the choice, not the engine.

    Args:
        name: of the engine to make, see :func:`make_engine`.

    Raises:
        InputError: on an unknown name.
    """

    def __init__(self, name: EngineName) -> None:
        check_engine(name)
        self.name = name
        self._made: tuple[Any, Engine | None] = (None, None)
        self._stale = False

    def get(self, network: Denoiser, sampler: Sampler) -> Engine:
        """Return the engine for ``network`` and ``sampler``.

        Raises:
            InputError: if the chosen engine cannot run the network.
        """
        parameter = network.like
        wanted = (network, sampler, parameter.device, parameter.dtype)
        made_for, engine = self._made  # read and replaced in one go: other threads may do the same
        if engine is None or made_for != wanted:
            engine = make_engine(self.name, network, sampler)
            if self._stale:  # what engines of a network share is older than this one
                engine.refresh()
            self._made, self._stale = (wanted, engine), False
        return engine

    def refresh(self) -> None:
        """Rebuild the engine at the next policy call from the network's weights at that time."""
        self._made, self._stale = (None, None), True

    def describe(self, network: Denoiser, sampler: Sampler) -> str:
        """Describe the engine and its device; for ``"auto"``, also why faster engines were not used."""
        engine = self.get(network, sampler)
        text = f"{engine.name}: {engine.detail}"
        if self.name != "auto":
            return text
        for name, entry in ENGINES.items():
            if name == engine.name:
                break
            text += f" (not {name}: {entry.applies(network)[1]})"
        return text

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "_made": (None, None), "_stale": False}
