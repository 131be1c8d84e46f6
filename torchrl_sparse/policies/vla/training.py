"""Training a vision-language-action policy on demonstrations, see `torchrl_sparse.policies.trainer`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import NonTensorStack, TensorDict
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from torchrl_sparse import keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.policies.trainer import TrainConfig, Trainer, split_windows
from torchrl_sparse.policies.vla.loss import VLALoss
from torchrl_sparse.policies.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["InstructedDemonstrations", "VLATrainer"]


@dataclass(frozen=True)
class InstructedDemonstrations:
    """Demonstrations, each with the instruction that it follows.

    Attributes:
        episodes: with the policy's cameras, u8 [N, 3, h, w], the state f32 [N, Ds] and the action f32 [N, A] of each step.
        instructions: one for each episode.
        grounding: f32 [N, G], what `VLALoss` is to ground the network in; None for nothing.

    Raises:
        ValueError: if there are not as many instructions as episodes.
    """

    episodes: Demonstrations
    instructions: Sequence[str]
    grounding: Tensor | None = None

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
            ``observed``, the instruction, ``("vla_action", "chunk")`` [B, H, A], ``"action_is_pad"`` [B, H] and, where there is
            one, ``"grounding"`` [B, G].
        """
        present, data = rows[:, 0].contiguous(), self.episodes.data
        sample = data.select(*observed)[present]
        sample[keys.CHUNK] = data.get(keys.ACTION)[rows]
        sample[keys.IS_PAD] = torch.cat(
            [torch.zeros(len(rows), 1).bool(), rows[:, 1:] == rows[:, :-1]], dim=1
        )
        if self.grounding is not None:
            sample[keys.GROUNDING] = self.grounding[present]
        episode = torch.searchsorted(self.episodes.starts, present, right=True) - 1
        sample[keys.INSTRUCTION] = NonTensorStack(*[self.instructions[i] for i in episode.tolist()])
        return sample


class VLATrainer(Trainer):
    """Trains a vision-language-action policy with the L1 loss on normalised action chunks.

    Args:
        policy: the policy, trained in place; its normaliser and tokenizer stay as they are.
        demos: demonstrations with images and instructions.
        config: how to train; ``n_action_steps`` is not read: windows may begin at every step of an episode.
        grounding_weight: of the auxiliary loss, where ``demos`` have a grounding; see `VLALoss`.

    Raises:
        ValueError: if ``val_ratio`` leaves no episode to train on.
    """

    def __init__(
        self,
        policy: VLAPolicy,
        demos: InstructedDemonstrations,
        config: TrainConfig,
        grounding_weight: float = 1.0,
    ):
        self.policy, self.demos, self.grounding_weight = policy, demos, grounding_weight
        loss = VLALoss(policy, 0 if demos.grounding is None else demos.grounding.shape[1], grounding_weight)
        loss.to(next(policy.network.parameters()).device)
        sizes = (policy.chunk_size, 1, policy.chunk_size)
        rows = split_windows(demos.episodes, sizes, config.val_ratio)
        super().__init__(loss, config, decay_groups(loss, config.weight_decay), *rows)

    def batch_loss(self, rows: Tensor) -> Tensor:
        observed = [*self.policy.network.config.cameras, keys.STATE]
        device = next(self.trained.parameters()).device
        batch = self.demos.windows(rows, observed).to(device)
        bf16 = torch.autocast(device.type, torch.bfloat16, enabled=self.config.precision == "bf16")
        with bf16, _training_attention(device):
            return self.trained(batch).get("loss")

    def averaged(self) -> VLANetwork:
        """A copy of the network with the averaged weights, in evaluation mode."""
        return super().averaged().policy.network

    def header(self) -> dict[str, dict]:
        data, network = self.demos.episodes.data, self.policy.network.config
        numbers = {"/".join(key): int(data[key].sum(dtype=torch.int64)) for key in network.cameras}
        numbers |= {name: float(data[name].double().sum()) for name in (keys.ACTION,)}
        grounding = self.demos.grounding
        numbers["grounding"] = 0.0 if grounding is None else float(grounding.double().abs().sum())
        return {
            "config": asdict(self.config) | {"grounding_weight": self.grounding_weight},
            "network_config": network.to_dict(),
            "data": {
                "windows": len(self.train_rows),
                "instructions": list(self.demos.instructions),
                **numbers,
            },
        }


@contextmanager
def _training_attention(device: torch.device) -> Iterator[None]:
    """On a CPU the plain products: PyTorch's fused kernel is the slower one there as soon as gradients are wanted."""
    with sdpa_kernel(SDPBackend.MATH) if device.type == "cpu" else nullcontext():
        yield


def decay_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Parameter groups for AdamW: matrices decay, vectors (biases, norms, scales) do not."""
    parameters = [*network.parameters()]
    matrices = [parameter for parameter in parameters if parameter.ndim > 1]
    vectors = [parameter for parameter in parameters if parameter.ndim <= 1]
    return [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
