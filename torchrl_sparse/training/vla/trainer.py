"""Training of a vision-language-action policy on demonstrations, see `torchrl_sparse.training.demonstrations`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import torch
from tensordict import NonTensorStack, TensorDict
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.optim.lr_scheduler import LambdaLR

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.vla import trained_state
from torchrl_sparse.training.demonstrations import (
    DemonstrationTrainer,
    TrainConfig,
    split_windows,
    trained_parameters,
)
from torchrl_sparse.training.trainer import checksum
from torchrl_sparse.training.vla.grounding import Grounding, GroundingConfig, ObjectPositions
from torchrl_sparse.training.vla.loss import VLALoss

__all__ = ["InstructedDemonstrations", "VLATrainer"]


@dataclass(frozen=True)
class InstructedDemonstrations:
    """Demonstrations, each with its instruction.

    Attributes:
        episodes: with the policy's cameras, u8 [N, 3, h, w], the state f32 [N, Ds] and the action f32 [N, A] of each step.
        instructions: one for each episode.
        objects: where things are in each step, for `Grounding`; None if that is not known.

    Raises:
        InputError: if there are not as many instructions as episodes.
    """

    episodes: Demonstrations
    instructions: Sequence[str]
    objects: ObjectPositions | None = None

    def __post_init__(self) -> None:
        if len(self.instructions) != len(self.episodes):
            raise InputError(
                f"instructions: expected one for each of {len(self.episodes)} episodes, got {len(self.instructions)}"
            )

    def windows(self, rows: Tensor, observed: Sequence) -> TensorDict:
        """Return training samples [B] for windows ``rows`` i64 [B, H], whose first row is the present.

        Args:
            rows: as from `Demonstrations.window_rows`; a row that repeats the one before is beyond the end.
            observed: keys to take from the present step.

        Returns:
            ``observed``, the instruction, ``("vla_action", "chunk")`` [B, H, A] and ``"action_is_pad"`` [B, H].
        """
        present, data = rows[:, 0].contiguous(), self.episodes.data
        sample = data.select(*observed)[present]
        sample[keys.CHUNK] = data.get(keys.ACTION)[rows]
        sample[keys.IS_PAD] = torch.cat(
            [torch.zeros(len(rows), 1).bool(), rows[:, 1:] == rows[:, :-1]], dim=1
        )
        episode = torch.searchsorted(self.episodes.starts, present, right=True) - 1
        sample[keys.INSTRUCTION] = NonTensorStack(*[self.instructions[i] for i in episode.tolist()])
        return sample


class VLATrainer(DemonstrationTrainer):
    """Trainer of a vision-language-action policy with the L1 loss on normalised action chunks.

    Args:
        policy: the policy, trained in place; its normaliser and tokenizer stay as they are.
        demos: demonstrations with images and instructions.
        config: how to train; ``n_action_steps`` is not read: windows may begin at every step of an episode.
        grounding: stages that come before the actions; none by default.

    Raises:
        InputError: if ``val_ratio`` leaves no episode to train on, or there are stages but no ``demos.objects``.
    """

    def __init__(
        self,
        policy: VLAPolicy,
        demos: InstructedDemonstrations,
        config: TrainConfig,
        grounding: GroundingConfig | None = None,
    ):
        self.policy, self.demos = policy, demos
        self.stages = GroundingConfig() if grounding is None else grounding
        self.loss = VLALoss(policy)
        parts = {"network": policy.network}
        if self.stages != GroundingConfig():
            if demos.objects is None:
                raise InputError("grounding: expected the objects' positions in the demonstrations, got none")
            device = next(policy.network.parameters()).device
            parts["grounding"] = Grounding(policy, len(demos.objects.instructions)).to(device)
        module = nn.ModuleDict(parts)
        sizes = (policy.chunk_size, 1, policy.chunk_size)
        rows = split_windows(demos.episodes, sizes, config.val_ratio)
        super().__init__(module, config, decay_groups(module, config.weight_decay), *rows)

    def window_loss(self, rows: Tensor) -> Tensor:
        observed = [*self.policy.network.config.cameras, keys.STATE]
        device = next(self.module.parameters()).device
        batch = self.demos.windows(rows, observed).to(device)
        with _precision(device, self.config.precision == "bf16"):
            if self.step >= self.stages.locate_steps + self.stages.refer_steps:
                return self.loss(batch).get("loss")
            return self._stage_loss(batch, rows[:, 0])

    def _stage_loss(self, batch: TensorDict, present: Tensor) -> Tensor:
        objects, grounding = self.demos.objects, self.module["grounding"]
        positions = objects.positions[present].to(batch[keys.STATE].device)
        if self.step < self.stages.locate_steps:
            return grounding.locate(self.policy, batch, positions)
        return grounding.refer(self.policy, batch, positions, objects.instructions)

    def make_lr_scheduler(self, optimizer: torch.optim.Optimizer) -> LambdaLR:
        """Return a cosine schedule with a warm-up whenever further parts start to learn."""
        stages = self.stages
        begins = (0, stages.locate_steps, stages.locate_steps + stages.refer_steps)

        def factor(step: int) -> float:
            since = step - max(begin for begin in begins if begin <= step)
            warm = since / self.warmup_steps if since < self.warmup_steps else 1.0
            return warm * 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.total)))

        return LambdaLR(optimizer, factor, last_epoch=self.step - 1)

    def averaged(self) -> VLANetwork:
        """Return a copy of the network with the averaged weights, in evaluation mode."""
        return super().averaged()["network"]

    def state(self) -> dict[str, Any]:
        """Return a checkpoint's content, without an adapted language model's weights, which are in its own file."""
        state = super().state()
        if self.policy.base is not None:
            own = {f"network.{name}" for name in trained_state(self.policy.network, self.policy.base)}
            weights = state["network"].items()
            state["network"] = {n: v for n, v in weights if n in own or not n.startswith("network.")}
        return state

    def load_state(self, state: dict[str, Any]) -> None:
        super().load_state(state | {"network": self.module.state_dict() | state["network"]})

    def header(self) -> dict[str, dict]:
        base = {} if self.policy.base is None else {"base": asdict(self.policy.base)}
        return {
            "config": asdict(self.config) | asdict(self.stages) | base,
            "network_config": self.policy.network.config.to_dict(),
            "data": {
                "windows": len(self.train_rows),
                "instructions": list(self.demos.instructions),
                **self._data_sums,
            },
        }

    @cached_property
    def _data_sums(self) -> dict[str, float]:
        """Return sums that tell one set of demonstrations from another. Pictures are read once, not at every checkpoint."""
        data, objects = self.demos.episodes.data, self.demos.objects
        sums = {"/".join(key): checksum(data[key]) for key in self.policy.network.config.cameras}
        sums[keys.ACTION] = checksum(data[keys.ACTION])
        if self.stages != GroundingConfig():
            sums["objects"] = checksum(objects.positions.abs())
        return sums


@contextmanager
def _precision(device: torch.device, bf16: bool) -> Iterator[None]:
    """Enter autocast to bf16 if asked for, where the gradient of fused attention is slower than plain products on a CPU."""
    plain = sdpa_kernel(SDPBackend.MATH) if bf16 and device.type == "cpu" else nullcontext()
    with torch.autocast(device.type, torch.bfloat16, enabled=bf16), plain:
        yield


def decay_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Return AdamW parameter groups: matrices decay; vectors (biases, norms, scales) do not."""
    parameters = trained_parameters(network)
    matrices = [parameter for parameter in parameters if parameter.ndim > 1]
    vectors = [parameter for parameter in parameters if parameter.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
