"""The interface of every engine: one policy call, from noise and prune mask to actions."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_sparse.blocks.mask import Reuse, check_reuse, validate_mask
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler

__all__ = ["Engine", "Overhead", "check_input", "check_query"]


class Overhead(NamedTuple):
    """Multiply-accumulates outside the blocks, batch 1.

    Attributes:
        step: of every denoising step.
        memory: of every step that computes cross-attention.
        query: once.
    """

    step: int
    memory: int
    query: int


class Engine(Protocol):
    """Base of the engines, each of which runs policy calls of one network and sampler; see
    :func:`torchrl_sparse.blocks.engine.make_engine`.

    An engine answers for the weights that its network has when it is asked. It sees optimiser steps,
    ``load_state_dict``, moves, and parameters or modules that were exchanged. Writes through ``parameter.data`` that
    leave the first values of the parameter as they were it cannot see: call :meth:`refresh` after those.

    Attributes:
        name: its name in :data:`~torchrl_sparse.blocks.engine.ENGINES`.
        detail: in a few words, what of the machine it uses.
    """

    name: str

    @property
    def detail(self) -> str: ...

    def denoise(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None = None,
        reuse: Reuse = "block",
        guide: Guide | None = None,
    ) -> Tensor:
        """Return normalised actions f32 [B, H, A], as :func:`torchrl_sparse.blocks.engine.denoise` defines them.

        Args:
            noise: f32 [B, K, H, A], standard normal; of the network's type and device. There may be no rows.
            cond: f32 [B, To, D], encoded observations, the same.
            mask: bool [B, K, 3L], True = pruned, row 0 all False; None prunes nothing. It is checked here, once a
                policy call.
            reuse: what a pruned block adds, see :mod:`torchrl_sparse.blocks.mask`.
            guide: actions that the call is guided toward; of the network's type and device.

        Raises:
            InputError: naming what was expected and what came (:func:`check_query`).
        """
        ...

    def refresh(self) -> None:
        """Read the network's weights again at the next policy call."""
        ...

    def block_seconds(self, repeats: int = 20) -> dict[str, float]:
        """Measure the seconds of one block of each of the network's types, ``{"SA": ..., "FFN": ..., ...}``, batch 1."""
        ...

    def block_macs(self) -> tuple[int, ...]:
        """Return the multiply-accumulates of one SA, one CA and one FFN block in this engine, batch 1."""
        ...

    def overhead_macs(self) -> Overhead:
        """Return the multiply-accumulates outside the blocks."""
        ...


def check_query(
    network: Denoiser,
    sampler: Sampler,
    noise: Tensor,
    cond: Tensor,
    mask: Tensor | None = None,
    reuse: str = "block",
    guide: Guide | None = None,
) -> None:
    """Refuse arguments that no engine can run; they are those of :func:`torchrl_sparse.blocks.engine.denoise`.

    Raises:
        MaskError: an InputError, if the mask is no prune mask for the policy call.
        InputError: naming what was expected and what came.
    """
    num_steps, batch = (
        sampler.num_inference_steps,
        cond.shape[0] if isinstance(cond, Tensor) and cond.ndim else 1,
    )
    chunk = network.horizon, network.input_dim
    expected = {"cond": (batch, network.n_obs_steps, network.cond_dim), "noise": (batch, num_steps, *chunk)}
    given = {"cond": cond, "noise": noise}
    if guide is not None:
        expected |= {"guide.actions": (batch, *chunk), "guide.pull": (batch, network.horizon, 1)}
        given |= {"guide.actions": guide.actions, "guide.pull": guide.pull}
    for name, shape in expected.items():
        check_input(name, given[name], shape, network.like)
    if guide is not None and not ((guide.pull >= 0) & (guide.pull <= 1)).all():
        raise InputError(f"guide.pull: expected numbers in [0, 1], got {guide.pull.flatten().tolist()}")
    if mask is not None:
        validate_mask(mask, num_steps, network.n_layer, (batch,), network.block_types)
    check_reuse(reuse)


def check_input(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor) -> None:
    """Raise InputError unless ``tensor`` is dense, has this shape, and has the type and device of ``like``."""
    if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or tensor.is_nested:
        came = f"layout {tensor.layout}" if isinstance(tensor, Tensor) else type(tensor).__name__
        raise InputError(f"{name}: expected a dense tensor, got {came}")
    if tuple(tensor.shape) != shape:
        raise InputError(f"{name}: expected shape {list(shape)}, got {list(tensor.shape)}")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise InputError(
            f"{name}: expected {like.dtype} on {like.device}, as the network, got {tensor.dtype} on {tensor.device}"
        )
