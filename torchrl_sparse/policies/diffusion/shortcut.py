"""A whole query in two calls of compiled code, where nothing between its state and its chunk is asked for.

Stages that only move tensors cost as much as a denoising step: after a query, the caches have lost what Python and PyTorch
run on, and each operation has to fetch it anew. So where the stages are those of the library, the state is all that the
policy reads and the mask is known, the native engine takes the state and gives the condition, all other keys are written, and
then it gives the chunk. The keys are the same, and so is every bit of them.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.packing import units
from torchrl_sparse.blocks.planner import Planner, StaticPlanner
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.denoiser import NOISES, ActionDenoiser
from torchrl_sparse.policies.diffusion.encoder import ObservationEncoder
from torchrl_sparse.policies.diffusion.warm_start import ColdStart

__all__ = ["answer_directly"]


def answer_directly(
    tensordict: TensorDictBase,
    encode: ObservationEncoder,
    start: ColdStart,
    plan: Planner,
    denoise: ActionDenoiser,
) -> bool:
    """Write what the four stages would, or return False and leave everything as it is where they have to run themselves."""
    # A plain TensorDict keeps the tensor that it is given, which can then be filled.
    if type(tensordict) is not TensorDict or not _known(encode, start, plan, denoise):
        return False
    network, sampler, normalizer = denoise.network, denoise.sampler, denoise.normalizer
    engine = denoise.current_engine()
    state = tensordict.get(encode.condition.state_key, None)
    if type(engine) is not NativeEngine or type(state) is not Tensor or not _is_plain(state):
        return False
    batch = tensordict.batch_size
    if state.shape != (*batch, *encode.state_shape):
        return False
    scales = units(normalizer)
    cond = engine.condition(state.reshape(-1, *encode.state_shape), scales)
    if cond is None:  # the encoder says what is wrong with the state
        return False
    mask, seed = plan.static_mask, encode.seed(tensordict)
    shape = (network.horizon, network.input_dim)
    noise = NOISES[denoise.noise](seed.reshape(-1), sampler.num_inference_steps, shape)
    packed = engine.ready(noise, cond)
    chunk = torch.empty(*batch, network.horizon - network.n_obs_steps + 1, network.input_dim)
    # Before the engine's call, which leaves nothing of what writes keys in the caches.
    tensordict.set(keys.COND, cond.view(state.shape))
    tensordict.set(keys.SEED, seed)
    masks = mask.expand(*batch, *mask.shape).clone(memory_format=torch.contiguous_format)
    tensordict.set(keys.PRUNE_MASK, masks)
    tensordict.set(keys.FLOPS, torch.full((*batch, 1), denoise.static_flops(mask)))
    tensordict.set(keys.CHUNK, chunk)
    engine.answer(packed, noise, cond, scales, mask, chunk, plan.reuse)
    return True


def _known(encode: ObservationEncoder, start: ColdStart, plan: Planner, denoise: ActionDenoiser) -> bool:
    """Return whether the stages do what they do in the library, without anybody looking in between."""
    kind, condition, normalizer = type(plan), encode.condition, denoise.normalizer
    return (
        kind.forward is Planner.forward
        and getattr(kind, "masks", None) is StaticPlanner.masks
        and type(encode) is ObservationEncoder
        and type(start) is ColdStart
        and type(denoise) is ActionDenoiser
        and condition.vision is None
        and type(normalizer) is Normalizer
        and condition.normalizer is normalizer
        and all(map(_is_plain, normalizer._buffers.values()))
        and not denoise.network.training
        and not any(map(_is_watched, (encode, start, plan, denoise)))
    )


def _is_watched(stage: TensorDictModuleBase) -> bool:
    return bool(stage._forward_hooks or stage._forward_pre_hooks)


def _is_plain(tensor: Tensor) -> bool:
    """Return whether compiled code can read ``tensor`` where it lies."""
    strided = tensor.layout == torch.strided and tensor.is_contiguous()
    return strided and tensor.dtype == torch.float32 and tensor.is_cpu and not tensor.requires_grad
