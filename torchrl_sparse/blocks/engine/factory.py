"""The table of engines, and how a policy holds the one that it runs in."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from torchrl_sparse.blocks.engine.base import Engine
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.blocks.engine.reference import ReferenceEngine
from torchrl_sparse.blocks.engine.torch.engine import TorchEngine
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["ENGINES", "EngineEntry", "EngineName", "EngineSlot", "check_engine", "make_engine"]

EngineName = str  # a name in ENGINES, or "auto"
Applies = Callable[[TransformerForDiffusion], tuple[bool, str]]


def _always(network: TransformerForDiffusion) -> tuple[bool, str]:
    return True, ""


class EngineEntry(NamedTuple):
    """An engine in :data:`ENGINES`.

    Attributes:
        make: makes it for a network and a sampler; raises ValueError where it does not apply.
        applies: says whether it can run a network on this machine, and if not, why.
        recalls: whether what it makes is a `RecallingEngine`.

    Examples:
        >>> ENGINES["mine"] = EngineEntry(ReferenceEngine)  # any class that offers what `Engine` says
        >>> "mine" in ENGINES
        True
        >>> del ENGINES["mine"]
    """

    make: Callable[[TransformerForDiffusion, Sampler], Engine]
    applies: Applies = _always
    recalls: bool = False


# By name; "auto" takes the first that applies, so that those that round come last.
ENGINES: dict[str, EngineEntry] = {
    "native": EngineEntry(NativeEngine, native_supports, recalls=True),
    "torch": EngineEntry(TorchEngine),
    "reference": EngineEntry(ReferenceEngine, recalls=True),
    "native_bf16": EngineEntry(partial(NativeEngine, weights="bfloat16"), native_supports, recalls=True),
    "native_int8": EngineEntry(partial(NativeEngine, weights="int8"), native_supports, recalls=True),
}


def check_engine(name: str, recalls: bool = False) -> None:
    """Raise ValueError unless ``name`` is in :data:`ENGINES`, or ``"auto"``; with ``recalls``, unless that engine recalls.

    The PyTorch engine does not: its programs add a run of pruned blocks as one sum of outputs of this query, and what a row
    recalls is in no such sum.
    """
    names = ["auto", *_able(recalls)]
    if name not in names:
        whose = " with a planner that recalls" if recalls else ""
        raise ValueError(f"engine: expected one of {names}{whose}, got {name!r}")


def _able(recalls: bool) -> list[str]:
    return [name for name, entry in ENGINES.items() if entry.recalls or not recalls]


def make_engine(
    name: EngineName, network: TransformerForDiffusion, sampler: Sampler, *, recalls: bool = False
) -> Engine:
    """Make the engine ``name`` for ``network`` and ``sampler``.

    ``"auto"`` takes the first of :data:`ENGINES` that applies: native on a CPU where it was built, else torch, or, with
    ``recalls``, the reference.

    Raises:
        ValueError: on an unknown name, or if the engine cannot run the network here or does not recall where it is to; the
            message says why.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> make_engine("torch", network, Sampler("ddim", 10)).name
        'torch'
    """
    check_engine(name, recalls)
    if name == "auto":
        name = next(name for name in _able(recalls) if ENGINES[name].applies(network)[0])
    applies, reason = ENGINES[name].applies(network)
    if not applies:
        raise ValueError(f"{name} engine: {reason}")
    return ENGINES[name].make(network, sampler)


class EngineSlot:
    """Holds the engine of a policy: made when it is first needed, and anew for another sampler or device.

    Copies and pickles carry the choice, not the engine.

    Args:
        name: of the engine to make, see :func:`make_engine`.

    Raises:
        ValueError: on an unknown name.
    """

    def __init__(self, name: EngineName) -> None:
        check_engine(name)
        self.name = name
        self._made: tuple[Any, Engine | None] = (None, None)
        self._stale = False

    def get(self, network: TransformerForDiffusion, sampler: Sampler, *, recalls: bool = False) -> Engine:
        """Return the engine for ``network`` and ``sampler``, a `RecallingEngine` if it is to recall.

        Raises:
            ValueError: if the chosen engine cannot run the network, or does not recall.
        """
        parameter = network.pos_emb
        wanted = (network, sampler, recalls, parameter.device, parameter.dtype)
        made_for, engine = self._made  # read and replaced in one go: other threads may do the same
        if engine is None or made_for != wanted:
            engine = make_engine(self.name, network, sampler, recalls=recalls)
            if self._stale:  # what engines of a network share is older than this one
                engine.refresh()
            self._made, self._stale = (wanted, engine), False
        return engine

    def refresh(self) -> None:
        """Make the engine anew in the next query, from the weights that the network has then."""
        self._made, self._stale = (None, None), True

    def describe(self, network: TransformerForDiffusion, sampler: Sampler, *, recalls: bool = False) -> str:
        """Say which engine runs and on what; if ``"auto"`` had to pass over others, why."""
        engine = self.get(network, sampler, recalls=recalls)
        text = f"{engine.name}: {engine.detail}"
        if self.name != "auto":
            return text
        for name, entry in ENGINES.items():
            if name == engine.name:
                break
            reason = "it does not recall" if recalls and not entry.recalls else entry.applies(network)[1]
            text += f" (not {name}: {reason})"
        return text

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "_made": (None, None), "_stale": False}
