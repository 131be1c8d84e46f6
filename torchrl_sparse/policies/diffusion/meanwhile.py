"""Planning while the cameras' encoder runs.

A learned planner takes time before the first denoising step. TTS (Test-time Sparsity, arXiv:2605.13316) takes it off a query's
path: its release decides on a CUDA stream of its own, beside the first step, which nothing is pruned of. Here a planner that
reads the state alone, ``Planner.unseen``, needs nothing of the cameras' encoder, which takes far longer than any step, and
decides in a thread of its own while that runs. Answers are the same, bit for bit.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.policies.diffusion.denoiser import ActionDenoiser
from torchrl_sparse.policies.diffusion.encoder import ConditionEncoder, ObservationEncoder
from torchrl_sparse.policies.diffusion.warm_start import ColdStart

__all__ = ["answer_meanwhile"]


def answer_meanwhile(
    tensordict: TensorDictBase,
    encode: ObservationEncoder,
    start: ColdStart,
    plan: Planner,
    denoise: ActionDenoiser,
) -> bool:
    """Run the four stages, the first and the third at once, or return False and do nothing where they cannot."""
    vision, state = encode.condition.vision, tensordict.get(keys.HISTORY_STATE, None)
    needless = vision is None or plan.is_static or plan.unseen < vision.feature_dim
    if needless or not isinstance(state, Tensor) or not state.is_cpu:
        return False
    asked = tensordict.select(*(key for key in plan.in_keys if key != keys.COND), strict=False)
    # A thread for each query takes some 0.1 ms of one that has cameras; one that is kept would not survive a fork.
    with ThreadPoolExecutor(1) as pool:
        planned = pool.submit(_plan, plan, encode.condition, state, asked)
        encode(tensordict)
    tensordict.update(planned.result().select(*plan.out_keys))
    denoise(start(tensordict))
    return True


@torch.no_grad()
def _plan(plan: Planner, condition: ConditionEncoder, state: Tensor, asked: TensorDictBase) -> TensorDictBase:
    """Return ``asked`` with what the planner writes, given zeros for what it does not read."""
    seen = condition.normalizer.normalize_state(state)
    blank = seen.new_zeros(*seen.shape[:-1], condition.vision.feature_dim)
    return plan(asked.set(keys.COND, torch.cat([blank, seen], dim=-1)))
