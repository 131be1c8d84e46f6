"""Training objective of OpenVLA-OFT (arXiv:2502.19645): the L1 distance of whole action chunks."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.vla.policy import VLAPolicy

__all__ = ["VLALoss", "chunk_l1"]


def chunk_l1(predicted: Tensor, target: Tensor, is_pad: Tensor | None = None) -> Tensor:
    """Return the mean absolute difference of action chunks [B, H, A], without actions where ``is_pad``, bool [B, H], is True.

    >>> import torch
    >>> target = torch.tensor([[[1.0], [9.0]]])
    >>> chunk_l1(torch.zeros(1, 2, 1), target, torch.tensor([[False, True]])).item()
    1.0
    """
    distance = (predicted - target).abs().mean(-1)
    return distance.mean() if is_pad is None else distance[~is_pad].mean()


class VLALoss(LossModule):
    """L1 loss of a `VLAPolicy` on normalised actions.

    Reads what the policy reads, the recorded chunk ``("vla_action", "chunk")`` f32 [B, H, A] in environment units, and, where
    it is there, ``"action_is_pad"`` bool [B, H] (as TorchRL's ``ActionChunkTransform`` writes both); writes ``"loss"``.

    Args:
        policy: the policy to train; its parameters are the loss module's.

    Examples:
        >>> import torch
        >>> from torchrl_sparse.networks.vla.config import VLAConfig
        >>> from torchrl_sparse.networks.vla.network import VLANetwork
        >>> loss = VLALoss(VLAPolicy(VLANetwork(VLAConfig.tiny())))
        >>> image = torch.zeros(3, 3, 28, 28, dtype=torch.uint8)
        >>> observation = {"image": image, "wrist_image": image, "state": torch.zeros(3, 8)}
        >>> batch = TensorDict({"observation": observation, "language_instruction": "lift"}, [3])
        >>> loss(batch.set(keys.CHUNK, torch.zeros(3, 2, 7)))["loss"].shape
        torch.Size([])
    """

    out_keys = ["loss"]

    def __init__(self, policy: VLAPolicy):
        super().__init__()
        self.policy = policy
        self.in_keys = [*policy.in_keys, keys.CHUNK, keys.IS_PAD]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``{"loss": scalar}`` for a batch [B].

        Raises:
            InputError: if the chunk does not have the policy's length and action size.
        """
        chunk = keys.read(tensordict, keys.CHUNK)
        expected = (self.policy.chunk_size, self.policy.action_dim)
        if tuple(chunk.shape[1:]) != expected:
            raise InputError(
                f"{keys.CHUNK}: expected [B, {expected[0]}, {expected[1]}], got {list(chunk.shape)}"
            )
        predicted, _ = self.policy.predict(tensordict.select(*self.policy.in_keys, strict=False))
        target = self.policy.normalizer.normalize_action(chunk)
        return TensorDict({"loss": chunk_l1(predicted, target, tensordict.get(keys.IS_PAD, None))}, [])
