"""Auxiliary training stages for randomly initialised towers and decoder: locate all objects, then those that words refer to.

Published models begin with towers and a language model that were trained on pictures and texts of the internet. A small
network without them tends to ignore its images: the arm's own pose predicts most of the next actions. Two stages before the
actions prevent that; only the weights that they leave remain:

1. `Grounding.locate`: regress the positions of all objects from the visual tokens.
2. `Grounding.refer`: regress, from the decoder's readout, the position of the object that the instruction refers to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NonTensorStack, TensorDictBase
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.normalize import MIN_RANGE
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["Grounding", "GroundingConfig", "ObjectPositions"]

_LOCATE_WEIGHT = 0.3  # of the first stage's loss in the second


@dataclass(frozen=True)
class GroundingConfig:
    """Numbers of optimiser steps per stage.

    Attributes:
        locate_steps: first steps of a training, in which objects are located from visual tokens, without the decoder.
        refer_steps: steps after those, in which the whole network locates the object that the instruction refers to.

    Raises:
        InputError: if one is negative.
    """

    locate_steps: int = 0
    refer_steps: int = 0

    def __post_init__(self) -> None:
        if min(self.locate_steps, self.refer_steps) < 0:
            raise InputError(
                f"locate_steps, refer_steps: expected at least 0, got {self.locate_steps} and {self.refer_steps}"
            )


@dataclass(frozen=True)
class ObjectPositions:
    """Positions of a scene's n objects at each step, and the instruction that refers to each.

    Attributes:
        positions: f32 [N, n, 3].
        instructions: n of them.

    Raises:
        InputError: if there are not as many instructions as objects.

    Examples:
        >>> things = ObjectPositions(torch.rand(50, 2, 3), ["lift the red cube", "lift the green cube"])
        >>> things.standardised().positions.mean((0, 1)).abs().max() < 1e-5
        tensor(True)
    """

    positions: Tensor
    instructions: Sequence[str]

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[1:] != (len(self.instructions), 3):
            raise InputError(
                f"positions: expected [N, {len(self.instructions)}, 3], one object for each instruction, "
                f"got {list(self.positions.shape)}"
            )

    def standardised(self) -> ObjectPositions:
        """Return positions centred at zero, with unit size along the axis of largest variation.

        Raises:
            InputError: if they vary on none, as one object's that nothing moves: there is nothing to locate.
        """
        positions = self.positions.double()  # or the last bit would depend on the number of threads
        centred = positions - positions.mean((0, 1))
        size = centred.std((0, 1), correction=0).max()
        if not size > MIN_RANGE:
            raise InputError(
                f"object_positions: expected some that vary by more than {MIN_RANGE} m, got a deviation of {size:.1e} m; "
                "locate_steps=0 and refer_steps=0 train without them"
            )
        return ObjectPositions((centred / centred.std((0, 1)).max()).float(), self.instructions)


class Grounding(nn.Module):
    """Losses of both stages, with linear position regressors that are not part of the policy.

    Args:
        policy: whose network is trained; its parameters are not this module's.
        objects: number of objects n.
    """

    def __init__(self, policy: VLAPolicy, objects: int):
        super().__init__()
        config = policy.network.config
        self.cameras = len(config.cameras)
        self.from_vision = nn.Linear(self.cameras * config.llm.dim, objects * 3)
        self.from_readout = nn.Linear(config.llm.dim, 3)

    def locate(self, policy: VLAPolicy, batch: TensorDictBase, positions: Tensor) -> Tensor:
        """Return the L1 loss, a scalar, of ``positions`` f32 [B, n, 3] regressed from each camera's mean visual token."""
        return self._locate_loss(policy.network.visual_tokens(policy.crop_images(batch)), positions)

    def refer(
        self, policy: VLAPolicy, batch: TensorDictBase, positions: Tensor, instructions: Sequence[str]
    ) -> Tensor:
        """Return the L1 loss, a scalar, of a randomly chosen object's position, regressed from the action readout.

        Part of the loss of `locate` is added, so that vision keeps what it learnt until the decoder uses it.
        """
        asked = torch.randint(len(instructions), (len(positions),))
        words = NonTensorStack(*[instructions[index] for index in asked.tolist()])
        _, decoded = policy.predict(batch.copy().set(keys.INSTRUCTION, words))
        referred = self.from_readout(policy.network.readout(decoded).mean(1)).float()
        loss = (referred - positions[torch.arange(len(positions)), asked]).abs().mean()
        return loss + _LOCATE_WEIGHT * self._locate_loss(decoded.visual, positions)

    def _locate_loss(self, visual: Tensor, positions: Tensor) -> Tensor:
        views = visual.unflatten(1, (self.cameras, -1)).mean(2)
        return (self.from_vision(views.flatten(1)).float() - positions.flatten(1)).abs().mean()
