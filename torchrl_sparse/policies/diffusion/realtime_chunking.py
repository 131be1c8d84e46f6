"""Real-time chunking (RTC): policy calls guided toward the actions executed meanwhile, so that successive chunks join smoothly.

In a world that does not wait, the first d actions of a new chunk come too late: the old chunk's are played instead. A new chunk
that ignores them may continue from another place. Real-time chunking (RTC, arXiv:2506.07339) has every denoising step know
them: those d are certain, the rest of the old chunk is a wish that weighs less the later it is for (its Eq. 5, with e for the
end of what is left of the old chunk)::

    pull_i = 1                                     i < d
             c (e^c - 1) / (e - 1)                 d <= i < e,   c = (e - i) / (e - d + 1)
             0                                     i >= e

RTC was made for flows and moves each step along a gradient through the network. Here the clean prediction itself is drawn,
``clean + pull (old - clean)``, as inpainting by replacement does (RePaint, arXiv:2201.09865): the sample that the network sees
next agrees with the actions that are certain, and it denoises the others to fit them. That is one sum a step, runs in every
engine with every planner, and leaves the first d actions as they are played. What it does without is the
gradient's pull on the other actions within a step, so more than one step is needed for them to follow.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.warm_start import QueryStart, shift_chunk

__all__ = ["RealtimeChunking", "chunk_pull"]


def chunk_pull(delay: Tensor, left: Tensor, length: int) -> Tensor:
    """Return how strongly each new action is guided toward the old chunk's, f32 [B, length]: RTC's Eq. 5.

    Args:
        delay: i64 [B, 1], d, actions that are played before the new chunk takes over.
        left: i64 [B, 1], e, actions of the old chunk that are left; those that are played are certain all the same.

    >>> chunk_pull(torch.tensor([[2]]), torch.tensor([[5]]), 7).mul(100).round().int().tolist()
    [[100, 100, 49, 19, 4, 0, 0]]
    """
    index = torch.arange(length, device=delay.device)
    share = ((left - index) / (left - delay + 1).clamp(min=1)).clamp(0, 1)
    soft = share * torch.expm1(share) / (torch.e - 1)
    return torch.where(index < delay, 1.0, soft)


class RealtimeChunking(QueryStart):
    """Start that continues from the last chunk, see the module; ``policy.start = RealtimeChunking()`` enables it.

    Reads ``("control", "last_chunk")``, ``("control", "elapsed")`` and ``("control", "delay")``, which `RealtimeExecutor` hands
    to a policy that asks for them; `ChunkExecutor` has no inference delay and hands over none, which counts as 0. The first
    call of an episode, and calls that come without these keys, are guided toward nothing.

    A chunk must reach further than from one call to the end of the next: where nothing of it is left, nothing is wished for.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_sparse import DiffusionPolicy, Sampler
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddpm", 5, spacing="logsnr")
        >>> policy.start = RealtimeChunking()
        >>> last = {"last_chunk": torch.zeros(1, 9, 10), "elapsed": torch.tensor([[4]]), "delay": torch.tensor([[2]])}
        >>> query = TensorDict({"history": {"state": torch.zeros(1, 2, 19)}, "control": last}, [1])
        >>> policy(query)["vla_action", "chunk"][0, :2].abs().max().item() < 1e-6
        True
    """

    in_keys = [keys.LAST_CHUNK, keys.ELAPSED, keys.DELAY]
    out_keys = [keys.KNOWN, keys.PULL]

    @property
    def name(self) -> str:
        return "rtc"

    def bind(self, network: Denoiser, normalizer: Normalizer, sampler: Sampler) -> None:
        self._parts = network, normalizer  # in a tuple: they stay modules of the policy alone

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        network, normalizer = self._parts
        past, length = network.n_obs_steps - 1, network.horizon
        elapsed = keys.recall(tensordict, keys.ELAPSED, (1,), 0)
        begun = elapsed > 0
        known = tensordict.get(keys.COND).new_zeros(*elapsed.shape[:-1], length, network.input_dim)
        pull = known.new_zeros(*elapsed.shape[:-1], length, 1)
        if begun.any():
            old = keys.read(tensordict, keys.LAST_CHUNK)
            delay = keys.recall(tensordict, keys.DELAY, (1,), 0)
            # The network's first actions are those of the observations before the present one: they are free.
            going_on = normalizer.normalize_action(shift_chunk(old, elapsed - past, length))
            drawn = chunk_pull(delay, old.shape[-2] - elapsed, length - past)
            known = torch.where(begun[..., None], going_on, known)
            pull[..., past:, 0] = torch.where(begun, drawn, 0.0)
        tensordict.set(keys.KNOWN, known)
        return tensordict.set(keys.PULL, pull)
