"""Lessons for towers and a decoder that start from nothing: where things are, and which of them words name.

Published models begin with towers and a language model that were trained on the internet's pictures and texts. A small
network without such a past is tempted not to look: the arm's own pose tells most of what comes next. Two lessons before the
actions make up for it, of which nothing remains but the weights:

1. `Grounding.look`: the visual tokens tell where all objects are.
2. `Grounding.answer`: told to handle one of them, whichever, the network tells where that one is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NonTensorStack, TensorDictBase
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["Grounding", "GroundingConfig", "ObjectPositions"]

_REMEMBERED = 0.3  # weight of the first lesson's loss in the second


@dataclass(frozen=True)
class GroundingConfig:
    """How long each lesson takes.

    Attributes:
        look_steps: first steps of a training, in which visual tokens tell where things are; without the decoder.
        answer_steps: steps after those, in which the whole network tells where the thing is that words name.

    Raises:
        ValueError: if one is negative.
    """

    look_steps: int = 0
    answer_steps: int = 0

    def __post_init__(self) -> None:
        if min(self.look_steps, self.answer_steps) < 0:
            raise ValueError(
                f"expected look_steps >= 0 and answer_steps >= 0, got {self.look_steps} and {self.answer_steps}"
            )


@dataclass(frozen=True)
class ObjectPositions:
    """Where the n objects of a scene are, step by step, and the instruction that names each.

    Attributes:
        positions: f32 [N, n, 3].
        instructions: n of them.

    Raises:
        ValueError: if there are not as many instructions as objects.

    Examples:
        >>> things = ObjectPositions(torch.rand(50, 2, 3), ["lift the red cube", "lift the green cube"])
        >>> things.standardised().positions.mean((0, 1)).abs().max() < 1e-5
        tensor(True)
    """

    positions: Tensor
    instructions: Sequence[str]

    def __post_init__(self) -> None:
        if self.positions.ndim != 3 or self.positions.shape[1:] != (len(self.instructions), 3):
            raise ValueError(
                f"positions: expected [N, {len(self.instructions)}, 3], one object for each instruction, "
                f"got {list(self.positions.shape)}"
            )

    def standardised(self) -> ObjectPositions:
        """About zero, and of unit size along the axis on which they vary most."""
        positions = self.positions.double()  # or the last bit would depend on the number of threads
        centred = positions - positions.mean((0, 1))
        return ObjectPositions((centred / centred.std((0, 1)).max()).float(), self.instructions)


class Grounding(nn.Module):
    """What a policy is asked in both lessons, and the linear layers that read its answers. They are no part of the policy.

    Args:
        policy: whose network is to learn; its parameters are not this module's.
        objects: number of objects n.
    """

    def __init__(self, policy: VLAPolicy, objects: int):
        super().__init__()
        config = policy.network.config
        self.cameras = len(config.cameras)
        self.seen = nn.Linear(self.cameras * config.llm.dim, objects * 3)
        self.told = nn.Linear(config.llm.dim, 3)

    def look(self, policy: VLAPolicy, batch: TensorDictBase, positions: Tensor) -> Tensor:
        """L1 loss, a scalar: ``positions`` f32 [B, n, 3] from the mean of each camera's visual tokens."""
        return self._seen_loss(policy.network.visual_tokens(policy.crop_images(batch)), positions)

    def answer(
        self, policy: VLAPolicy, batch: TensorDictBase, positions: Tensor, instructions: Sequence[str]
    ) -> Tensor:
        """L1 loss, a scalar: from what actions are read from, the position of an object drawn for each sample.

        A part of `look`'s is added, so that vision does not forget it before the decoder has learnt to use it.
        """
        asked = torch.randint(len(instructions), (len(positions),))
        words = NonTensorStack(*[instructions[index] for index in asked.tolist()])
        _, decoded = policy.predict(batch.copy().set(keys.INSTRUCTION, words))
        told = self.told(policy.network.readout(decoded).mean(1)).float()
        told_loss = (told - positions[torch.arange(len(positions)), asked]).abs().mean()
        return told_loss + _REMEMBERED * self._seen_loss(decoded.visual, positions)

    def _seen_loss(self, visual: Tensor, positions: Tensor) -> Tensor:
        views = visual.unflatten(1, (self.cameras, -1)).mean(2)
        return (self.seen(views.flatten(1)).float() - positions.flatten(1)).abs().mean()
