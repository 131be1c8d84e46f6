"""The MLP of a learned planner in compiled code, ``pruner.h``: products with all cells of a mask, without state between calls.

PyTorch takes four passes over an activation of [K * 3L, hidden]; here a dozen cells at a time stay in the L1 cache.
"""

from __future__ import annotations

from ctypes import byref
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sparse.blocks.engine.native.arena import PANEL, Arena
from torchrl_sparse.blocks.engine.native.layout import CONSTANTS, Pruner
from torchrl_sparse.blocks.engine.native.library import instruction_level, loaded
from torchrl_sparse.errors import InputError

__all__ = ["MAX_HIDDEN", "NativePruner", "PrunerWeights"]

MAX_HIDDEN = CONSTANTS["MAX_HIDDEN"]


@dataclass(frozen=True)
class PrunerWeights:
    """Weights of an MLP over all blocks of all denoising steps, ``last(relu(middle(relu(fuse(obs(features)) + cells))))``.

    Each layer is a pair of a weight [outputs, inputs] and a bias [outputs], f32 on the CPU.

    Attributes:
        obs, fuse: of the observation's F features, one after the other.
        cells: [K, 3L, hidden], what a block of a step adds to the first hidden layer.
        middle: of the second hidden layer.
        last: of two logits, such as keep and prune, of which the second is weighed against the first.
    """

    obs: tuple[Tensor, Tensor]
    fuse: tuple[Tensor, Tensor]
    cells: Tensor
    middle: tuple[Tensor, Tensor]
    last: tuple[Tensor, Tensor]


class NativePruner:
    """The MLP of a learned planner in compiled code: each block's pruning logit minus its keeping logit. Not differentiable.

    The two linear layers before the sum over cells are one here, and of the last layer's two logits the difference. A
    row of a batch is computed exactly as it would be alone, on ``torch.get_num_threads()`` threads, whose number changes
    nothing. Calls from several threads may overlap.

    Args:
        weights: with at most `MAX_HIDDEN` hidden activations; they are copied. The compiled library has to be there.
        instruction_set: one of ``INSTRUCTION_SETS``; None takes the widest that the CPU has.

    Attributes:
        packed: the structure that the engine reads.
        hidden: activations of its hidden layers.

    Raises:
        InputError: if this CPU does not have the instruction set.

    Examples:
        >>> from torchrl_sparse.blocks.engine import native_available
        >>> square, pair = (torch.eye(8), torch.zeros(8)), (torch.ones(2, 8), torch.zeros(2))
        >>> weights = PrunerWeights(square, square, torch.zeros(4, 6, 8), square, pair)
        >>> if native_available()[0]:
        ...     assert NativePruner(weights).logits(torch.zeros(7, 8)).shape == (7, 4, 6)
    """

    def __init__(self, weights: PrunerWeights, instruction_set: str | None = None) -> None:
        self._level = instruction_level(instruction_set)
        self._arena = Arena()
        with torch.no_grad():
            self.packed = self._pack(weights)
        self.hidden = len(weights.last[0][0])
        self._features = weights.obs[0].shape[1]
        self._shape = weights.cells.shape[:2]

    def _pack(self, weights: PrunerWeights) -> Pruner:
        (obs, obs_bias), (fuse, fuse_bias), (last, last_bias) = weights.obs, weights.fuse, weights.last
        obs = fuse.double() @ obs.double()
        bias = fuse.double() @ obs_bias.double() + fuse_bias
        return Pruner(
            obs=self._arena.matrix(obs, bias),
            middle=self._arena.matrix(*weights.middle),
            cells=self._padded(weights.cells),
            last=self._padded(last[1] - last[0]),
            bias=(last_bias[1] - last_bias[0]).item(),
            count=weights.cells.shape[:2].numel(),
            first=weights.cells.shape[1],
        )

    def _padded(self, tensor: Tensor) -> int:
        return self._arena.floats(functional.pad(tensor, (0, -tensor.shape[-1] % PANEL)))

    def logits(self, features: Tensor) -> Tensor:
        """Return each block's pruning logit minus its keeping logit, f32 [B, K, 3L].

        Args:
            features: flat observations, and rates if they are an input, f32 [B, F] on the CPU.

        Raises:
            InputError: if there is another number of features than F.
        """
        logits = torch.empty(len(features), *self._shape, dtype=torch.float32, device="cpu")
        self._run(features, logits.data_ptr(), None)
        return logits

    def masks(self, features: Tensor) -> Tensor:
        """Return the prune masks, bool [B, K, 3L]: positive :meth:`logits`, and False in the first step."""
        masks = torch.empty(len(features), *self._shape, dtype=torch.bool, device="cpu")
        self._run(features, None, masks.data_ptr())
        return masks

    def _run(self, features: Tensor, logits: int | None, masks: int | None) -> None:
        shape, kind = (len(features), self._features), (features.dtype, features.device.type)
        if tuple(features.shape) != shape or kind != (torch.float32, "cpu"):
            raise InputError(
                f"features: expected torch.float32 [B, {self._features}] on cpu, "
                f"got {features.dtype} {list(features.shape)} on {features.device}"
            )
        features = features.contiguous()
        where = self._level, torch.get_num_threads()
        loaded().sparse_prune(*where, byref(self.packed), len(features), features.data_ptr(), logits, masks)
