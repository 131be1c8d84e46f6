"""Training a vision-language-action policy on demonstrations, see `torchrl_sparse.policies.trainer`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import NonTensorStack, TensorDict
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.trainer import TrainConfig, Trainer, split_windows
from torchrl_sparse.policies.vla.loss import VLALoss
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["InstructedDemonstrations", "VLATrainer"]


@dataclass(frozen=True)
class InstructedDemonstrations:
    """Demonstrations, each with the instruction that it follows.

    Attributes:
        episodes: with the policy's cameras, u8 [N, 3, h, w], the state f32 [N, Ds] and the action f32 [N, A] of each step.
        instructions: one for each episode.

    Raises:
        ValueError: if there are not as many instructions as episodes.
    """

    episodes: Demonstrations
    instructions: Sequence[str]

    def __post_init__(self) -> None:
        if len(self.instructions) != len(self.episodes):
            raise ValueError(
                f"instructions: expected one for each of {len(self.episodes)} episodes, got {len(self.instructions)}"
            )

    def windows(self, rows: Tensor, observed: Sequence) -> TensorDict:
        """Training samples [B] of windows ``rows`` i64 [B, H], whose first row is the present.

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


class VLATrainer(Trainer):
    """Trains a vision-language-action policy with the L1 loss on normalised action chunks.

    Args:
        policy: the policy, trained in place; its normaliser and tokenizer stay as they are.
        demos: demonstrations with images and instructions.
        config: how to train; ``n_action_steps`` is not read: windows may begin at every step of an episode.

    Raises:
        ValueError: if ``val_ratio`` leaves no episode to train on.
    """

    def __init__(self, policy: VLAPolicy, demos: InstructedDemonstrations, config: TrainConfig):
        self.policy, self.demos = policy, demos
        self.loss = VLALoss(policy)
        sizes = (policy.chunk_size, 1, policy.chunk_size)
        groups = decay_groups(policy.network, config.weight_decay)
        rows = split_windows(demos.episodes, sizes, config.val_ratio)
        super().__init__(policy.network, config, groups, *rows)

    def batch_loss(self, rows: Tensor) -> Tensor:
        observed = [*self.trained.config.cameras, keys.STATE]
        device = next(self.trained.parameters()).device
        batch = self.demos.windows(rows, observed).to(device)
        with torch.autocast(device.type, torch.bfloat16, enabled=self.config.precision == "bf16"):
            return self.loss(batch).get("loss")

    def header(self) -> dict[str, dict]:
        data = self.demos.episodes.data
        numbers = {
            "/".join(key): int(data[key].sum(dtype=torch.int64)) for key in self.trained.config.cameras
        }
        numbers |= {name: float(data[name].double().sum()) for name in (keys.ACTION,)}
        return {
            "config": asdict(self.config),
            "network_config": self.trained.config.to_dict(),
            "data": {
                "windows": len(self.train_rows),
                "instructions": list(self.demos.instructions),
                **numbers,
            },
        }


def decay_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Parameter groups for AdamW: matrices decay, vectors (biases, norms, scales) do not."""
    parameters = [*network.parameters()]
    matrices = [parameter for parameter in parameters if parameter.ndim > 1]
    vectors = [parameter for parameter in parameters if parameter.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
