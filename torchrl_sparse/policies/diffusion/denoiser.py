"""From a condition and a mask to a chunk of actions, and what that cost."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.factory import EngineName, EngineSlot
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.mask import REUSE_RULES, NetworkSizes, Reuse, mask_flops
from torchrl_sparse.networks.diffusion.noise import sample_noise
from torchrl_sparse.networks.diffusion.philox import philox_noise
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer

__all__ = ["NOISES", "ActionDenoiser", "check_noise"]

NOISES = {"torch": sample_noise, "philox": philox_noise}
"""What a seed stands for -> the function that draws it: PyTorch's generator, with which everything here was measured, or
`torchrl_sparse.networks.diffusion.philox`, as exported policies do."""


def check_noise(name: str) -> str:
    """Return ``name``, or raise ValueError unless it is in :data:`NOISES`."""
    if name not in NOISES:
        raise ValueError(f"noise: expected one of {list(NOISES)}, got {name!r}")
    return name


class ActionDenoiser(TensorDictModuleBase):
    """Denoises a chunk, leaving out the blocks that the mask prunes, and counts what that cost."""

    in_keys = [keys.COND, keys.SEED, keys.PRUNE_MASK, keys.REUSE]
    out_keys = [keys.CHUNK, keys.FLOPS]

    def __init__(
        self,
        network: TransformerForDiffusion,
        normalizer: Normalizer,
        sampler: Sampler,
        engine: EngineName,
    ):
        super().__init__()
        self.network = network
        self.normalizer = normalizer
        self.sampler = sampler
        self.engine = EngineSlot(engine)
        self.noise = "torch"

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = tensordict.batch_size
        rows = batch.numel()
        cond, mask = (
            value.reshape(rows, *value.shape[len(batch) :])
            for value in (tensordict.get(keys.COND), keys.read(tensordict, keys.PRUNE_MASK))
        )
        shape = (self.network.horizon, self.network.input_dim)
        seed = tensordict.get(keys.SEED).reshape(-1)
        noise = NOISES[self.noise](seed, self.sampler.num_inference_steps, shape)
        dtype = self.network.pos_emb.dtype
        noise, cond = noise.to(dtype), cond.to(dtype)
        actions = self._follow_rules(noise, cond, mask, keys.read(tensordict, keys.REUSE).reshape(-1))
        chunk = self.normalizer.unnormalize_action(actions[:, self.network.n_obs_steps - 1 :])
        tensordict.set(keys.CHUNK, chunk.reshape(*batch, *chunk.shape[1:]))
        return tensordict.set(keys.FLOPS, mask_flops(NetworkSizes.of(self.network), mask).reshape(*batch, 1))

    def _follow_rules(self, noise: Tensor, cond: Tensor, mask: Tensor, rules: Tensor) -> Tensor:
        """Denoise normalised actions, each row under the reuse rule of its own."""
        codes = sorted(set(rules.tolist()))
        if codes and not 0 <= codes[0] <= codes[-1] < len(REUSE_RULES):
            raise ValueError(
                f"{keys.REUSE}: expected an index of {list(REUSE_RULES)} for each row, got {codes}"
            )
        if len(codes) == 1:
            return self.run(noise, cond, mask, REUSE_RULES[codes[0]])
        actions = torch.empty_like(noise[:, 0])
        for code in codes:
            rows = rules == code
            actions[rows] = self.run(noise[rows], cond[rows], mask[rows], REUSE_RULES[code])
        return actions

    def run(self, noise: Tensor, cond: Tensor, mask: Tensor | None, reuse: Reuse) -> Tensor:
        """Denoise normalised actions [B, H, A], all that the network predicts."""
        if self.network.training or cond.requires_grad:
            return denoise(self.network, self.sampler, noise, cond, mask, reuse=reuse)
        return self.engine.get(self.network, self.sampler).denoise(noise, cond, mask, reuse)
