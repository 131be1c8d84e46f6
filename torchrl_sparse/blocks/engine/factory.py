"""Choosing and making engines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args

from torchrl_sparse.blocks.engine.base import Engine, ReferenceEngine
from torchrl_sparse.blocks.engine.native.engine import NativeEngine, native_supports
from torchrl_sparse.blocks.engine.torch.engine import TorchEngine

if TYPE_CHECKING:
    from torchrl_sparse.networks.diffusion.sampler import Sampler
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["EngineName", "EngineSlot", "check_engine", "make_engine"]

EngineName = Literal["auto", "reference", "torch", "native"]


def check_engine(name: str) -> None:
    """Raise ValueError unless ``name`` is an :data:`EngineName`."""
    if name not in get_args(EngineName):
        raise ValueError(f"engine: expected one of {list(get_args(EngineName))}, got {name!r}")


def make_engine(name: EngineName, network: TransformerForDiffusion, sampler: Sampler) -> Engine:
    """The engine ``name`` for ``network`` and ``sampler``.

    ``"auto"`` takes the fastest that applies: native on a CPU where it was built, else torch.

    Raises:
        ValueError: on an unknown name, or if ``"native"`` cannot run the network here; the message says why.

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
    if name == "reference":
        return ReferenceEngine(network, sampler)
    if name == "native" or (name == "auto" and native_supports(network)[0]):
        return NativeEngine(network, sampler)
    return TorchEngine(network, sampler)


class EngineSlot:
    """Holds the engine of a policy: made when it is first needed, and anew for another sampler or device.

    Copies and pickles carry the choice, not the engine.

    Args:
        name: what to make, see :func:`make_engine`.

    Raises:
        ValueError: on an unknown name.
    """

    def __init__(self, name: EngineName) -> None:
        check_engine(name)
        self.name = name
        self._made: tuple[Any, Engine | None] = (None, None)

    def get(self, network: TransformerForDiffusion, sampler: Sampler) -> Engine:
        """The engine for ``network`` and ``sampler``.

        Raises:
            ValueError: if the chosen engine cannot run the network.
        """
        parameter = network.pos_emb
        wanted = (network, sampler, parameter.device, parameter.dtype)
        made_for, engine = self._made  # read and replaced in one go: other threads may do the same
        if engine is None or made_for != wanted:
            engine = make_engine(self.name, network, sampler)
            self._made = wanted, engine
        return engine

    def describe(self, network: TransformerForDiffusion, sampler: Sampler) -> str:
        """Which engine runs and on what; if ``"auto"`` had to do without the native one, why."""
        engine = self.get(network, sampler)
        text = f"{engine.name}: {engine.detail}"
        if self.name == "auto" and engine.name != "native":
            text += f" (not native: {native_supports(network)[1]})"
        return text

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "_made": (None, None)}
