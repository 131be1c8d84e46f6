"""Fast path of a policy call: state to chunk in two native calls.

Stages that only move tensors cost as much as a denoising step: after a call, the caches have lost what Python and PyTorch
run on, and each operation has to fetch it again. So where the stages are those of the library, the state is all that the
policy reads and the mask is known, the native engine takes the state and gives the condition, all other keys are written, and
then it gives the chunk. The keys are the same, and so is every bit of them.
"""

from __future__ import annotations

import copy
import time

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.packing import units
from torchrl_sparse.blocks.planner import Planner, StaticPlanner
from torchrl_sparse.networks.frozen import Frozen
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.denoiser import NOISES, ActionDenoiser
from torchrl_sparse.policies.diffusion.encoder import ObservationEncoder
from torchrl_sparse.policies.diffusion.warm_start import QueryStart

__all__ = ["Parts", "answer_directly"]


class Parts:
    """Values read from the policy's stages: at every policy call, or once for a frozen policy.

    Copies and pickles of it are None: those of a frozen policy are not frozen.

    Args:
        encode: the stage that encodes; see `Parts.of`.
        denoise: the stage that denoises.
        frozen: the normaliser's weights where these and the parts of both stages stay; None where they may change.
    """

    def __init__(
        self, encode: ObservationEncoder, denoise: ActionDenoiser, frozen: Frozen | None = None
    ) -> None:
        self.encode, self.denoise, self.network, self.frozen = encode, denoise, denoise.network, frozen
        # What is frozen stays as it is, but may be moved through its storage: of that, a copy is read.
        self._normalizer = denoise.normalizer if frozen is None else copy.deepcopy(denoise.normalizer)
        self.scales = units(self._normalizer)

    def __reduce__(self) -> tuple:
        return type(None), ()

    @classmethod
    def of(
        cls, encode: ObservationEncoder, denoise: ActionDenoiser, frozen: Frozen | None = None
    ) -> Parts | None:
        """Return the parts, or None if stages are not the library's own or native code cannot read the normaliser."""
        if type(encode) is not ObservationEncoder or type(denoise) is not ActionDenoiser:
            return None
        condition, normalizer = encode.condition, denoise.normalizer
        known = (
            condition.vision is None
            and type(normalizer) is Normalizer
            and condition.normalizer is normalizer
            and all(map(_is_plain, normalizer._buffers.values()))
        )
        return cls(encode, denoise, frozen) if known else None


def answer_directly(
    began: float,
    parts: Parts | None,
    tensordict: TensorDictBase,
    encode: ObservationEncoder,
    start: QueryStart,
    plan: Planner,
    denoise: ActionDenoiser,
) -> bool:
    """Write the outputs of all four stages, or return False and change nothing if the stages must run themselves.

    Args:
        began: when the policy call began, as ``time.perf_counter`` has it; its latency is written, too.
        parts: those of a frozen policy.
    """
    # A plain TensorDict keeps the tensor that it is given, which can then be filled.
    if type(tensordict) is not TensorDict or not _stay_unseen(encode, start, plan, denoise):
        return False
    if parts is None or parts.encode is not encode or parts.denoise is not denoise:
        parts = Parts.of(encode, denoise)
    if parts is None or parts.network.training:
        return False
    if parts.frozen is not None:
        parts.frozen.check()
    network, sampler, scales = parts.network, denoise.sampler, parts.scales
    engine = denoise.engine.get(network, sampler)
    state = tensordict.get(encode.condition.state_key, None)
    if type(engine) is not NativeEngine or type(state) is not Tensor or not _is_plain(state):
        return False
    batch = tensordict.batch_size
    if state.shape != (*batch, *encode.state_shape):
        return False
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
    latency = torch.full((*batch, 1), 0.0)
    tensordict.set(keys.LATENCY, latency)
    seconds = latency.numpy()
    engine.answer(packed, noise, cond, scales, mask, chunk, plan.reuse)
    seconds.fill(time.perf_counter() - began)
    return True


def _stay_unseen(*stages: TensorDictModuleBase) -> bool:
    """Return whether the second does nothing, the third has one mask for all, and nobody looks in between."""
    _, start, plan, _ = stages
    kind = type(plan)
    return (
        kind.forward is Planner.forward
        and getattr(kind, "masks", None) is StaticPlanner.masks
        and type(start) is QueryStart
        and not any(stage._forward_hooks or stage._forward_pre_hooks for stage in stages)
    )


def _is_plain(tensor: Tensor) -> bool:
    """Return whether compiled code can read ``tensor`` where it lies."""
    strided = tensor.layout == torch.strided and tensor.is_contiguous()
    return strided and tensor.dtype == torch.float32 and tensor.is_cpu and not tensor.requires_grad
