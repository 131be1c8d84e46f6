"""A pruner's MLP in the compiled code of ``native.cpp``: a product with all cells of a mask, and nothing kept between.

PyTorch takes four passes over an activation of [K * 3L, hidden]; here a dozen cells at a time stay in the L1 cache.
"""

from __future__ import annotations

import ctypes
from ctypes import byref, c_float, c_int32, c_void_p
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.blocks.engine.native.library import instruction_level, library
from torchrl_sparse.blocks.engine.native.packing import PANEL, Arena, Matrix

if TYPE_CHECKING:
    from torchrl_sparse.blocks.sag.network import PrunerNetwork

__all__ = ["MAX_HIDDEN", "NativeGates"]

MAX_HIDDEN = 256  # of native.cpp, which keeps a dozen cells on the stack


class _Gates(ctypes.Structure):
    """``struct Gates`` of native.cpp."""

    _fields_ = [
        *((name, Matrix) for name in ("obs", "middle")),
        *((name, c_void_p) for name in ("cells", "last")),
        ("bias", c_float),
        ("count", c_int32),
        ("first", c_int32),
    ]


class NativeGates:
    """Computes :meth:`PrunerNetwork.prune_logits` with the weights that the network has now. Not differentiable.

    The two linear layers before the sum over cells are one here, and of the last layer's two logits the difference. A
    row of a batch is computed exactly as it would be alone. Calls from several threads may overlap.

    Args:
        network: with float32 weights on the CPU and at most `MAX_HIDDEN` hidden activations; the compiled library has
            to be there.
        instruction_set: one of ``INSTRUCTION_SETS``; None takes the widest that the CPU has.

    Raises:
        ValueError: if this CPU does not have the instruction set.

    Examples:
        >>> from torchrl_sparse.blocks.engine import native_available
        >>> from torchrl_sparse.blocks.sag.network import PrunerNetwork
        >>> network = PrunerNetwork([3, 2, 1, 0], num_blocks=6, cond_shape=(2, 5)).eval()
        >>> if native_available()[0]:
        ...     assert NativeGates(network).logits(torch.zeros(7, 10)).shape == (7, 4, 6)
    """

    def __init__(self, network: PrunerNetwork, instruction_set: str | None = None) -> None:
        self._level = instruction_level(instruction_set)
        self._arena = Arena()
        with torch.no_grad():
            self._gates = self._pack(network)
        self._features = network.obs.in_features
        self._shape = len(network.timesteps), network.num_blocks

    def _pack(self, network: PrunerNetwork) -> _Gates:
        first, second = network.obs, network.fuse_obs
        weight = second.weight.double() @ first.weight.double()
        bias = second.weight.double() @ first.bias.double() + second.bias
        _, middle, _, last = network.mlp
        cells = network.cells()
        return _Gates(
            obs=self._arena.matrix(weight, bias),
            middle=self._arena.matrix(middle.weight, middle.bias),
            cells=self._padded(cells),
            last=self._padded(last.weight[1] - last.weight[0]),
            bias=(last.bias[1] - last.bias[0]).item(),
            count=len(cells),
            first=network.num_blocks,
        )

    def _padded(self, tensor: Tensor) -> int:
        return self._arena.floats(functional.pad(tensor, (0, -tensor.shape[-1] % PANEL)))

    def logits(self, features: Tensor) -> Tensor:
        """By how much pruning is preferred, f32 [B, K, 3L].

        Args:
            features: flat observations, and rates if the network reads them, f32 [B, F] on the CPU.

        Raises:
            ValueError: if they do not have the network's number of features.
        """
        logits = torch.empty(len(features), *self._shape)
        self._run(features, logits.data_ptr(), None)
        return logits

    def masks(self, features: Tensor) -> Tensor:
        """Where pruning is preferred, bool [B, K, 3L], False in the first step; see :meth:`logits`."""
        masks = torch.empty(len(features), *self._shape, dtype=torch.bool)
        self._run(features, None, masks.data_ptr())
        return masks

    def _run(self, features: Tensor, logits: int | None, masks: int | None) -> None:
        if features.shape[1] != self._features:
            raise ValueError(f"features: expected [B, {self._features}], got {list(features.shape)}")
        features = features.contiguous()
        gates = byref(self._gates)
        library().sparse_prune(self._level, gates, len(features), features.data_ptr(), logits, masks)
