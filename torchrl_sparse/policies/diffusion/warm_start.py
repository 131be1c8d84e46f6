"""Warm starts: policy calls that begin from the last chunk instead of noise, so that one or two network calls suffice.

Most of what a policy is asked for it has planned before: the actions of the last chunk for the steps that are still to
come. A warm start shifts that chunk to the present step, noises it to the timestep of one of the sampler's last steps,
and denoises from there (SDEdit, arXiv:2108.01073, along an episode)::

    guess_i = last[elapsed + i]            i = 0 .. H - 1, counted from the present step; the ends are repeated
    sample  = sqrt(abar_t) guess + sqrt(1 - abar_t) gaussian          t = timesteps[K - n]
    actions = the sampler's last n steps from sample

Nothing is trained and the equations are the sampler's own, from its own table. The first call of an episode has no last
chunk and takes all K steps. RTI-DP (arXiv:2508.05396) and Falcon (arXiv:2503.00339) begin from earlier results too, with
other rules for how far back: Falcon keeps the noisy samples of earlier calls and chooses among their noise levels by a
distance, RTI-DP begins from the shifted solution at a fixed level and rescales what is discrete.

How much of a guess is known decides what this is worth. Published horizons leave little: of ten actions that begin one
step in the past eight are executed, so a shift by eight knows two and repeats the last of them eight times. Re-planning
every one to four steps is what warm starts are made for (`ChunkExecutor.n_action_steps`).

Streaming Diffusion Policy (arXiv:2406.04806) goes further and keeps every action of a chunk at a noise level of its own.
That needs a network that was trained with a timestep for each action. This one has a single timestep token for a chunk
(``TransformerForDiffusion.memory``), and has only seen chunks of one noise level: it cannot be asked.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer

__all__ = ["QueryStart", "WarmStart", "shift_chunk", "stored_start"]


def shift_chunk(chunk: Tensor, by: Tensor, length: int) -> Tensor:
    """Return the entries ``by``, ``by + 1``, ... of ``chunk``, f32 [B, length, A], repeating its first and last one.

    Args:
        chunk: f32 [B, n, A].
        by: i64 [B, 1]; may be negative.

    >>> shift_chunk(torch.arange(4.0)[None, :, None], torch.tensor([[2]]), 4).flatten().tolist()
    [2.0, 3.0, 3.0, 3.0]
    """
    index = (by + torch.arange(length, device=chunk.device)).clamp(0, chunk.shape[-2] - 1)
    return chunk.gather(-2, index[..., None].expand(*index.shape, chunk.shape[-1]))


class QueryStart(TensorDictModuleBase):
    """Default start, from noise: reads and writes nothing.

    A stage of one's own subclasses it, reads what it likes, and writes ``("diffusion", "start")`` f32 [*B, H, A], a
    normalised guess of the actions, and ``("diffusion", "num_steps")`` i64 [*B, 1], how many of the sampler's last steps
    to take from there; K begins from noise. Or ``("diffusion", "known")`` f32 [*B, H, A] and ``("diffusion", "pull")``
    f32 [*B, H, 1], normalised actions that every step is guided toward, and how far.
    """

    in_keys: list[NestedKey] = []
    out_keys: list[NestedKey] = []

    def bind(self, network: Denoiser, normalizer: Normalizer, sampler: Sampler) -> None:
        """Prepare to serve a policy of these parts; it calls this when it is given the start or another sampler.

        Raises:
            InputError: if the start cannot serve them; it then stays as it was.
        """

    @property
    def name(self) -> str:
        """Name for people and logs; empty for starts from noise."""
        return ""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict


class WarmStart(QueryStart):
    """Start from the last chunk, see the module; ``policy.start = WarmStart(1)`` enables it.

    Reads ``("control", "last_chunk")`` and ``("control", "elapsed")``, which `ChunkExecutor` hands to a policy that asks for
    them. Samples at the beginning of their episode, and calls that come without these keys, begin from noise.

    Args:
        num_steps: the sampler's last steps that a warm call takes, n >= 1; a sampler of as many or fewer is refused.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl_sparse import DiffusionPolicy, Sampler
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddpm", timesteps=[82, 14])
        >>> policy.start = WarmStart(1)
        >>> query = TensorDict({"history": {"state": torch.zeros(2, 2, 19)}}, [2])
        >>> query["control", "last_chunk"] = torch.zeros(2, 9, 10)
        >>> query["control", "elapsed"] = torch.tensor([[0], [2]])  # the first is at the beginning of its episode
        >>> policy(query)["diffusion", "num_steps"].flatten().tolist()
        [2, 1]
    """

    in_keys = [keys.LAST_CHUNK, keys.ELAPSED]
    out_keys = [keys.START, keys.NUM_STEPS]

    def __init__(self, num_steps: int) -> None:
        super().__init__()
        if num_steps < 1:
            raise InputError(f"num_steps: expected at least 1, got {num_steps}")
        self.num_steps = num_steps

    @property
    def name(self) -> str:
        return f"warm{self.num_steps}"

    def bind(self, network: Denoiser, normalizer: Normalizer, sampler: Sampler) -> None:
        if self.num_steps >= sampler.num_inference_steps:
            raise InputError(
                f"num_steps: expected fewer than the sampler's {sampler.num_inference_steps}, got {self.num_steps}"
            )
        self._parts = network, normalizer, sampler  # in a tuple: they stay modules of the policy alone

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        network, normalizer, sampler = self._parts
        elapsed = keys.recall(tensordict, keys.ELAPSED, (1,), 0)
        warm = elapsed > 0
        guess = tensordict.get(keys.COND).new_zeros(*elapsed.shape[:-1], network.horizon, network.input_dim)
        if warm.any():
            # The network's first actions are those of the observations before the present one.
            first = elapsed - (network.n_obs_steps - 1)
            last = shift_chunk(keys.read(tensordict, keys.LAST_CHUNK), first, network.horizon)
            guess = torch.where(warm[..., None], normalizer.normalize_action(last), guess)
        tensordict.set(keys.START, guess)
        return tensordict.set(keys.NUM_STEPS, torch.where(warm, self.num_steps, sampler.num_inference_steps))


def stored_start(start: QueryStart) -> int | None:
    """Return the start for a policy's file: the steps of a warm policy call, or None for starts from noise.

    Raises:
        InputError: for a start of another class.

    >>> stored_start(WarmStart(2)), stored_start(QueryStart())
    (2, None)
    """
    if type(start) not in (QueryStart, WarmStart):
        raise InputError(f"start: expected None or a WarmStart, to save it, got {type(start).__name__}")
    return start.num_steps if isinstance(start, WarmStart) else None
