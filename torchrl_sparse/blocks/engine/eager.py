"""The eager baseline: a policy call as the published implementation of Diffusion Policy runs it.

``torch.nn.TransformerDecoder`` and a diffusers sampler that draws its own noise, step by step
(arXiv:2303.04137, ``DiffusionTransformerLowdimPolicy``). Speed-ups are quoted against it; nothing else uses
it.
"""

from __future__ import annotations

import torch
from diffusers import DDIMScheduler, DDPMScheduler
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.spacing import falls_evenly
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

__all__ = ["EagerBaseline", "published_forward"]


def published_forward(
    network: TransformerForDiffusion, sample: Tensor, timestep: Tensor, cond: Tensor
) -> Tensor:
    """Predict the noise [B, H, A] through PyTorch's own decoder module."""
    memory = network.memory(timestep, cond)
    x = network.decoder(
        tgt=network.embed(sample), memory=memory, tgt_mask=network.mask, memory_mask=network.memory_mask
    )
    return network.head_out(x)


def _diffusers_scheduler(sampler: Sampler) -> DDPMScheduler | DDIMScheduler:
    """Make diffusers' own, or raise InputError if it would step elsewhere."""
    options = {"num_train_timesteps": sampler.num_train_timesteps, "beta_schedule": "squaredcos_cap_v2"}
    options |= {"clip_sample_range": sampler.clip_sample_range}
    if sampler.kind == "ddpm":
        scheduler = DDPMScheduler(variance_type="fixed_small", **options)
        scheduler.set_timesteps(timesteps=sampler.timesteps.tolist())
        return scheduler
    if sampler.kind != "ddim" or not falls_evenly(sampler.timesteps.tolist(), sampler.num_train_timesteps):
        raise InputError(f"eager baseline: diffusers has no sampler {sampler.name!r} that clips and steps so")
    scheduler = DDIMScheduler(set_alpha_to_one=True, steps_offset=0, **options)
    scheduler.set_timesteps(sampler.num_inference_steps)
    return scheduler


class EagerBaseline:
    """Engine that denoises with the modules and the sampler of the published implementation.

    Args:
        network: the denoiser, in eval mode.
        sampler: the sampler.
        compiled: put :func:`published_forward` through ``torch.compile``; on a GPU with CUDA graphs, which make it fastest.

    Raises:
        InputError: for a sampler that diffusers does not have: its solvers do not clip, and its DDIM always steps down
            by T // K.

    Examples:
        >>> from torchrl_sparse.networks.diffusion.sampler import Sampler
        >>> from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
        >>> network = TransformerForDiffusion(
        ...     input_dim=7, output_dim=7, horizon=4, n_obs_steps=2, cond_dim=5, n_layer=1, n_emb=16
        ... ).eval()
        >>> eager = EagerBaseline(network, Sampler("ddim", 10))
        >>> eager.denoise(torch.randn(1, 4, 7), torch.randn(1, 2, 5)).shape
        torch.Size([1, 4, 7])
    """

    def __init__(self, network: TransformerForDiffusion, sampler: Sampler, *, compiled: bool = False) -> None:
        self._network, self._scheduler = network, _diffusers_scheduler(sampler)
        self._timesteps, self._eta = sampler.timesteps, sampler.eta
        mode = "reduce-overhead" if network.pos_emb.device.type == "cuda" else "default"
        self._forward = torch.compile(published_forward, mode=mode) if compiled else published_forward

    @torch.no_grad()
    def denoise(
        self,
        sample: Tensor,
        cond: Tensor,
        mask: Tensor | None = None,
        *,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Return normalised actions [B, H, A].

        Args:
            sample: initial noise f32 [B, H, A].
            cond: encoded observations f32 [B, To, D].
            mask: bool [K, 3L], one for the whole batch, True = pruned, row 0 all False: blocks are skipped by
                an ``if`` around each and reuse their own latest output, as caching methods are commonly
                published. None runs the decoder.
            generator: of the noise that the sampler adds.
        """
        extra = {"generator": generator}
        if isinstance(self._scheduler, DDIMScheduler):
            extra["eta"] = self._eta
        computed = None if mask is None else (~mask).tolist()
        latest: list[Tensor | None] = [None] * self._network.num_blocks
        for step, timestep in enumerate(self._timesteps):
            if computed is None:
                eps = self._forward(self._network, sample, timestep, cond)
            else:
                eps = self._skipping_forward(sample, timestep, cond, computed[step], latest)
            sample = self._scheduler.step(eps, timestep, sample, **extra).prev_sample
        return sample

    def _skipping_forward(
        self, sample: Tensor, timestep: Tensor, cond: Tensor, computed: list[bool], latest: list
    ) -> Tensor:
        network = self._network
        x, memory = network.embed(sample), network.memory(timestep, cond)
        for block in range(network.num_blocks):
            if computed[block]:
                latest[block] = network.block(block, x, memory)
            x = x + latest[block]
        return network.head_out(x)
