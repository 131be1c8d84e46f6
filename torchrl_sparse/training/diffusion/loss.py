"""Training objective of Diffusion Policy (arXiv:2303.04137, Eq. 5): predict the noise of a noised chunk."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.encoder import ConditionEncoder

__all__ = ["DiffusionLoss", "noise_prediction_loss"]


def noise_prediction_loss(
    network: TransformerForDiffusion,
    sampler: Sampler,
    action: Tensor,
    cond: Tensor,
    noise: Tensor,
    timestep: Tensor,
) -> Tensor:
    """Return the mean squared error, a scalar, of the network's prediction of ``noise``.

    Args:
        network: noise predictor.
        sampler: noises the actions.
        action: normalised chunks [B, H, A].
        cond: encoded observations [B, To, D].
        noise: standard normal [B, H, A].
        timestep: i64 [B], one for each chunk.
    """
    noisy = sampler.add_noise(action, noise, timestep)
    return torch.nn.functional.mse_loss(network(noisy, timestep, cond).float(), noise)


class DiffusionLoss(LossModule):
    """Chunked noise-prediction loss.

    Reads ``("history", "state")`` [B, To, Ds] and ``"action"`` [B, H, A], both in environment units, with
    ``vision`` also the cameras' histories; writes ``"loss"``. Timestep and noise are drawn from torch's global generator.

    Args:
        network: the network to train; its parameters are the loss module's.
        normalizer: of states and actions.
        sampler: gives the noise levels; DDPM with 100 by default.
        vision: encoder of the cameras, if the policy has any; trained with the network.

    Examples:
        >>> network = TransformerForDiffusion(
        ...     input_dim=10, output_dim=10, horizon=4, n_obs_steps=2, cond_dim=3, n_layer=1
        ... )
        >>> normalizer = Normalizer(torch.ones(3), torch.zeros(3), torch.ones(10), torch.zeros(10))
        >>> loss = DiffusionLoss(network, normalizer)
        >>> batch = {("history", "state"): torch.zeros(5, 2, 3), "action": torch.zeros(5, 4, 10)}
        >>> loss(TensorDict(batch, [5]))["loss"].shape
        torch.Size([])
    """

    out_keys = ["loss"]

    def __init__(
        self,
        network: TransformerForDiffusion,
        normalizer: Normalizer,
        sampler: Sampler | None = None,
        vision: VisionEncoder | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        self.normalizer = normalizer
        self.condition = ConditionEncoder(normalizer, vision)
        self.in_keys = [*self.condition.in_keys, keys.ACTION]
        self.sampler = Sampler() if sampler is None else sampler

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``{"loss": scalar}`` for a batch.

        Raises:
            InputError: if the chunk does not have the network's horizon and action size.
        """
        action = tensordict.get(keys.ACTION)
        chunk = (self.network.horizon, self.network.input_dim)
        if action.ndim != 3 or tuple(action.shape[1:]) != chunk:
            raise InputError(
                f"{keys.ACTION}: expected shape [B, {chunk[0]}, {chunk[1]}], got {list(action.shape)}"
            )
        action = self.normalizer.normalize_action(action)
        cond = self.condition(tensordict)
        timestep = torch.randint(self.sampler.num_train_timesteps, (len(action),), device=action.device)
        noise = torch.randn_like(action)
        loss = noise_prediction_loss(self.network, self.sampler, action, cond, noise, timestep)
        return TensorDict({"loss": loss}, batch_size=[])
