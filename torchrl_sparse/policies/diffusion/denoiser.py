"""Denoising of a chunk of actions from a condition and a mask, with its cost."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.blocks.engine.base import Engine
from torchrl_sparse.blocks.engine.factory import EngineName, EngineSlot, check_engine
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.mask import NetworkSizes, Reuse, mask_flops
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.noise import sample_noise
from torchrl_sparse.networks.diffusion.philox import philox_noise
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.normalize import Normalizer

__all__ = ["NOISES", "ActionDenoiser", "check_noise"]

NOISES = {"torch": sample_noise, "philox": philox_noise}
"""What a seed stands for -> the function that draws it: PyTorch's generator, with which everything here was measured, or
`torchrl_sparse.networks.diffusion.philox`, as exported policies do."""


def check_noise(name: str) -> str:
    """Return ``name``, or raise InputError unless it is in :data:`NOISES`."""
    if name not in NOISES:
        raise InputError(f"noise: expected one of {list(NOISES)}, got {name!r}")
    return name


class ActionDenoiser(TensorDictModuleBase):
    """Module that denoises a chunk without the pruned blocks, and counts the cost.

    Attributes:
        warm: whether policy calls say where they begin, see :mod:`torchrl_sparse.policies.diffusion.warm_start`.
        guided: whether they say what they are guided toward, see :mod:`torchrl_sparse.policies.diffusion.realtime_chunking`.
        planning_flops: of the planner, which are counted with the loop's.
        reuse: what a pruned block adds, as the planner that wrote the mask has it.
    """

    def __init__(
        self,
        network: Denoiser,
        normalizer: Normalizer,
        sampler: Sampler,
        engine: EngineName,
    ):
        super().__init__()
        self.network = network
        self.normalizer = normalizer
        self.warm = self.guided = False
        self.planning_flops = 0
        self._plan: tuple[Planner, ...] = ()
        self._tails: dict[tuple, tuple[Sampler, EngineSlot]] = {}
        self.sampler = sampler
        self.engine = EngineSlot(engine)
        self.noise = "torch"
        self._counted: tuple[Tensor | None, float] = (None, 0.0)

    @property
    def in_keys(self) -> list[NestedKey]:
        own = [keys.COND, keys.SEED, keys.PRUNE_MASK]
        return [*own, *self._begin_keys(), *self._guide_keys()]

    def _begin_keys(self) -> list:
        return [keys.START, keys.NUM_STEPS] if self.warm else []

    def _guide_keys(self) -> list:
        return [keys.KNOWN, keys.PULL] if self.guided else []

    @property
    def out_keys(self) -> list[NestedKey]:
        return [keys.CHUNK, keys.FLOPS]

    @property
    def reuse(self) -> Reuse:
        (plan,) = self._plan
        return plan.reuse

    def follow(self, plan: Planner) -> None:
        """Take reuse rule and planning FLOPs from the planner that writes the masks, from the next policy call on."""
        self._plan = (plan,)  # in a tuple, since the planner is a stage of its own and no part of this one
        self.planning_flops = plan.flops

    def choose(self, engine: EngineName) -> None:
        """Switch to another engine from the next policy call on; ValueError as in `check_engine`."""
        check_engine(engine)
        self.engine = EngineSlot(engine)

    def describe(self) -> str:
        """Describe the engine and its device, and why no faster engine is used."""
        return self.engine.describe(self.network, self.sampler)

    def current_engine(self) -> Engine:
        """Return the current engine of policy calls."""
        return self.engine.get(self.network, self.sampler)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch = tensordict.batch_size
        wanted = [keys.COND, keys.PRUNE_MASK, *self._begin_keys()]
        cond, mask, *begin = (_flat(keys.read(tensordict, key), batch) for key in wanted)
        guided = [_flat(keys.read(tensordict, key), batch).to(cond) for key in self._guide_keys()]
        shape = (self.network.horizon, self.network.input_dim)
        seed = tensordict.get(keys.SEED).reshape(-1)
        noise = NOISES[self.noise](seed, self.sampler.num_inference_steps, shape)
        dtype = self.network.like.dtype
        noise, cond = noise.to(dtype), cond.to(dtype)
        guide = Guide(*guided) if guided else None
        actions, flops = self._denoise(noise, cond, mask, guide, *begin)
        chunk = self.normalizer.unnormalize_action(actions[:, self.network.n_obs_steps - 1 :])
        tensordict.set(keys.CHUNK, chunk.reshape(*batch, *chunk.shape[1:]))
        if self.planning_flops:
            flops = flops + self.planning_flops
        return tensordict.set(keys.FLOPS, flops.reshape(*batch, 1))

    def static_flops(self, mask: Tensor) -> float:
        """Count the FLOPs of a policy call under a planner's constant mask [K, 3L], once."""
        known, flops = self._counted  # read and replaced in one go: other threads may do the same
        if known is not mask:
            flops = mask_flops(NetworkSizes.of(self.network), mask).item() + self.planning_flops
            self._counted = mask, flops
        return flops

    def _denoise(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor,
        guide: Guide | None,
        start: Tensor | None = None,
        num_steps: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return normalised actions [B, H, A] and FLOPs [B] of policy calls, each with as many steps as it takes."""
        whole, sizes = self.sampler.num_inference_steps, NetworkSizes.of(self.network)
        steps = None if num_steps is None else num_steps.flatten()
        numbers = [whole] if steps is None else sorted(set(steps.tolist()))
        if steps is None or start is None or numbers in ([], [whole]):
            return self.run(noise, cond, mask, self.reuse, None, guide), mask_flops(sizes, mask)
        if not 1 <= numbers[0] <= numbers[-1] <= whole:
            raise InputError(f"{keys.NUM_STEPS}: expected 1 to {whole} steps, got {numbers}")
        actions, flops = torch.empty_like(noise[:, 0]), cond.new_empty(len(cond))
        for number in numbers:
            rows = steps == number
            part = self._last_steps(number, noise[rows], mask[rows], start[rows].to(noise))
            drawn = None if guide is None else guide.rows(rows)
            actions[rows] = self.run(part[0], cond[rows], part[1], self.reuse, number, drawn)
            flops[rows] = mask_flops(sizes, part[1]).to(flops)
        return actions, flops

    def _last_steps(self, number: int, noise: Tensor, mask: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return noise and mask of the last steps, from a guess noised to the first of them, which has nothing to reuse."""
        if number == self.sampler.num_inference_steps:
            return noise, mask
        noise, mask = noise[:, :number].clone(), mask[:, -number:].clone()
        timestep = self.sampler.timesteps[-number].expand(len(noise)).to(noise.device)
        noise[:, 0] = self.sampler.add_noise(start, noise[:, 0], timestep)
        mask[:, 0] = False
        return noise, mask

    def run(
        self,
        noise: Tensor,
        cond: Tensor,
        mask: Tensor | None,
        reuse: Reuse,
        number: int | None = None,
        guide: Guide | None = None,
    ) -> Tensor:
        """Denoise normalised actions [B, H, A] over the network's whole horizon, in all steps or the last ``number``."""
        sampler, slot = self.sampler, self.engine
        if number not in (None, sampler.num_inference_steps):
            sampler, slot = self._tail(number)
        if self.network.training or cond.requires_grad:
            return denoise(self.network, sampler, noise, cond, mask, reuse=reuse, guide=guide)
        return slot.get(self.network, sampler).denoise(noise, cond, mask, reuse, guide)

    def refresh(self) -> None:
        """Read all weights again at the next policy call."""
        self.engine.refresh()
        self._tails.clear()

    def _tail(self, number: int) -> tuple[Sampler, EngineSlot]:
        """Return the sampler of the last steps, and the engine that runs it."""
        made_for = self.sampler, self.engine, number
        if made_for not in self._tails:
            self._tails = {key: tail for key, tail in self._tails.items() if key[:2] == made_for[:2]}
            self._tails[made_for] = self.sampler.last_steps(number), EngineSlot(self.engine.name)
        return self._tails[made_for]


def _flat(tensor: Tensor, batch: torch.Size) -> Tensor:
    """Return [rows, ...] of [*batch, ...]."""
    return tensor.reshape(batch.numel(), *tensor.shape[len(batch) :])
