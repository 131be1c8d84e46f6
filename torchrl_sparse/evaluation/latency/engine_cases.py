"""Cases of the engine benchmark: network shapes, policy calls of different sparsity, and all engine variants.

A *call kind* is a sampler and a mask (``"dense"``, ``"random91"``, ``"ddim10"`` ...); a *variant* is one way of answering
one kind of call, named ``"<runner> <kind>"``. All variants of a case share weights, observations and noise, though
diffusers' sampler draws the noise itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import torch
from torch import Tensor

from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import calibrate
from torchrl_sparse.blocks.engine import Engine, NativeEngine, ReferenceEngine, TorchEngine
from torchrl_sparse.blocks.engine.eager import EagerBaseline
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.native.supports import native_supports
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.training.diffusion.published import published_network

__all__ = ["SHAPES", "EngineCase", "QueryKind", "Variant", "make_network"]

# The published networks by task, and what differs; the robomimic image tasks differ from low_dim in their condition.
SHAPES = {"low_dim": ("lift", {}), "image": ("lift", {"cond_dim": 137}), "kitchen": ("kitchen", {})}

_PRUNE_RATE = 0.91
_SHORT_PRUNE_RATE = 0.5  # ten steps of which the first computes everything cannot be pruned by 91 %
_NUM_UPDATES, _TOP_K = 10, 5  # the paper's
_RUNNERS = {"torch": TorchEngine, "native": NativeEngine}
# By runner, its weights and their bytes.
_ROUNDED_RUNNERS = {
    "native-fp16": ("float16", 2),
    "native-bf16": ("bfloat16", 2),
    "native-int8": ("int8", 1),
}
_FEW_KINDS = ("dense", "random91", "bac10", "ddim2")
_DRAWN_SEED = 1


def make_network(shape: str, **sizes: int) -> TransformerForDiffusion:
    """Make an untrained network of a published shape; ``sizes`` override arguments of `TransformerForDiffusion`.

    Raises:
        InputError: on an unknown shape.
    """
    if shape not in SHAPES:
        raise InputError(f"shape: expected one of {list(SHAPES)}, got {shape!r}")
    torch.manual_seed(0)
    task, changes = SHAPES[shape]
    return published_network(task, **changes, **sizes).eval().requires_grad_(False)


@dataclass(frozen=True)
class QueryKind:
    """A kind of policy call, defined by its sparsity.

    Attributes:
        sampler: the sampler, K steps.
        mask: bool [B, K, 3L]; None prunes nothing.
    """

    sampler: Sampler
    mask: Tensor | None = None

    def to(self, device: torch.device) -> QueryKind:
        """Return the same kind with its mask on ``device``."""
        return self if self.mask is None else QueryKind(self.sampler, self.mask.to(device))

    def evaluations(self) -> Tensor | None:
        """Count the steps in which at least one row computes each block, i64 [3L]; None: all of the steps."""
        return None if self.mask is None else (~self.mask.all(dim=0)).sum(dim=0).cpu()

    def row_evaluations(self, batch: int) -> int | Tensor:
        """Count the evaluations of each block over all rows, i64 [3L]; one number if all are equal."""
        if self.mask is None:
            return batch * self.sampler.num_inference_steps
        return (~self.mask).sum(dim=(0, 1)).cpu()


@dataclass(frozen=True)
class Variant:
    """One engine variant on one kind of policy call.

    Attributes:
        call: answers it once, with normalised actions [B, H, A].
        kind: of the call.
        dense: name of the variant that runs ``"dense"`` in the same runner.
        weight_bytes: size of a weight as the runner reads it.
        in_f32: whether the runner multiplies and adds in f32.
    """

    call: Callable[[], Tensor]
    kind: str
    dense: str
    weight_bytes: int = 4
    in_f32: bool = True


class EngineCase:
    """One network at one batch size, with all kinds of policy calls.

    Args:
        network: the denoiser, in eval mode, on the device that is to run everything.
        batch: rows B; each has a random mask of its own where masks are random.
        dense: sampler of the dense call, whose steps the caches are calibrated for; DDPM with 100 without it.
        compiled: also run the eager baseline through ``torch.compile``.
        bac_mask: of a schedule of BAC (arXiv:2506.13456) at M=10 for this network, bool [K, 3L]; None computes one from the
            first of the case's own calls, whose observation is noise.
        instruction_sets: also run the native engine on each of those that this CPU has.
    """

    def __init__(
        self,
        network: TransformerForDiffusion,
        batch: int,
        *,
        dense: Sampler | None = None,
        compiled: bool = False,
        bac_mask: Tensor | None = None,
        instruction_sets: bool = False,
    ) -> None:
        self.network, self.batch, self._compiled = network, batch, compiled
        self._instruction_sets = instruction_sets
        self.device = network.like.device
        self._dense = dense or Sampler("ddpm")
        generator = torch.Generator().manual_seed(0)
        self.cond = torch.randn(batch, network.n_obs_steps, network.cond_dim, generator=generator)
        self.cond = self.cond.to(self.device)
        shape = (batch, network.horizon, network.input_dim)
        initial = torch.randn(shape, generator=generator).to(self.device)
        # The eager baseline's sampler draws the steps' noise from a generator with this seed, in this order.
        drawn = torch.Generator(self.device).manual_seed(_DRAWN_SEED)
        noises = range(self._dense.num_inference_steps - 1)
        steps = [torch.randn(shape, generator=drawn, device=self.device) for _ in noises]
        self.noise = torch.stack([initial, *steps], dim=1)
        mask = self._calibrate_bac() if bac_mask is None else bac_mask
        queries = self._make_queries(generator, mask.repeat(batch, 1, 1))
        self.queries = {kind: query.to(self.device) for kind, query in queries.items()}

    def reference(self, kind: str) -> Tensor:
        """Return the reference engine's actions for a policy call, [B, H, A]."""
        query = self.queries[kind]
        return self._call(partial(ReferenceEngine, self.network, query.sampler), query)()

    def variants(self) -> dict[str, Variant]:
        """Return all engine variants on all kinds of policy calls, by name."""
        variants = self._eager_variants()
        variants["reference dense"] = Variant(partial(self.reference, "dense"), "dense", "reference dense")
        for runner, make in self._runners().items():
            # Made in its first call, which so takes all that is done once.
            engine = cache(partial(make, self.network))
            dtype, weight_bytes = _ROUNDED_RUNNERS.get(runner, ("float32", 4))
            in_f32 = dtype in ("float32", "float16")
            for kind, query in self.queries.items():
                if runner in _RUNNERS or kind in _FEW_KINDS:
                    call = self._call(partial(engine, query.sampler), query)
                    variants[f"{runner} {kind}"] = Variant(
                        call, kind, f"{runner} dense", weight_bytes, in_f32
                    )
        return variants

    def _runners(self) -> dict[str, Callable[[TransformerForDiffusion, Sampler], Engine]]:
        """Return by name what makes the engines; all but `_RUNNERS` answer few kinds of policy calls."""
        if not native_supports(self.network)[0]:
            return {"torch": TorchEngine}
        rounded = {
            name: partial(NativeEngine, weights=dtype) for name, (dtype, _) in _ROUNDED_RUNNERS.items()
        }
        sets = native_available()[1].split(", ") if self._instruction_sets else []
        return (
            _RUNNERS
            | rounded
            | {f"native-{name}": partial(NativeEngine, instruction_set=name) for name in sets}
        )

    def _call(self, engine: Callable[[], Engine], query: QueryKind) -> Callable[[], Tensor]:
        noise = self.noise[:, : query.sampler.num_inference_steps].contiguous()
        return lambda: engine().denoise(noise, self.cond, query.mask)

    def _eager_variants(self) -> dict[str, Variant]:
        kinds = [kind for kind, query in self.queries.items() if query.mask is None]
        calls = {f"eager {kind}": (kind, self._eager_call(kind)) for kind in kinds}
        if self._compiled:
            calls["eager-compiled dense"] = ("dense", self._eager_call("dense", compiled=True))
        if self.batch == 1:  # an `if` around a block skips it for all rows
            calls["eager-ifs random91"] = ("random91", self._eager_call("random91"))
        return {name: Variant(call, kind, "eager dense") for name, (kind, call) in calls.items()}

    def _eager_call(self, kind: str, compiled: bool = False) -> Callable[[], Tensor]:
        query = self.queries[kind]
        eager = EagerBaseline(self.network, query.sampler, compiled=compiled)
        mask = None if query.mask is None else query.mask[0]

        def call() -> Tensor:
            generator = torch.Generator(self.device).manual_seed(_DRAWN_SEED)
            return eager.denoise(self.noise[:, 0], self.cond, mask, generator=generator)

        return call

    def _make_queries(self, generator: torch.Generator, bac_masks: Tensor) -> dict[str, QueryKind]:
        dense, steps = self._dense, self._dense.num_inference_steps
        full = torch.linspace(0, steps - 1, max(1, round((1 - _PRUNE_RATE) * steps))).round().long()
        full_steps = torch.ones(self.batch, steps, self.network.num_blocks, dtype=torch.bool)
        full_steps[:, full] = False
        all_pruned = torch.ones_like(full_steps)
        all_pruned[:, 0] = False
        queries = {
            "dense": QueryKind(dense),
            "random91": QueryKind(dense, self._random_mask(steps, _PRUNE_RATE, generator)),
            "bac10": QueryKind(dense, bac_masks),
            f"full{len(full)}": QueryKind(dense, full_steps),
            "all-pruned": QueryKind(dense, all_pruned),
        }
        for count in (16, 10, 8):
            count = min(count, steps)
            queries[f"ddim{count}"] = QueryKind(self._ddim(count))
            mask = self._random_mask(count, _SHORT_PRUNE_RATE, generator)
            queries[f"ddim{count}-random50"] = QueryKind(self._ddim(count), mask)
        for count in range(min(3, steps), 0, -1):
            queries[f"ddim{count}"] = QueryKind(self._ddim(count))
        return queries

    def _ddim(self, num_steps: int) -> Sampler:
        return self._dense.variant("ddim", num_steps)

    def _random_mask(self, steps: int, rate: float, generator: torch.Generator) -> Tensor:
        """Draw for each row a mask of its own that prunes ``rate`` of all blocks, none in the first step."""
        blocks = self.network.num_blocks
        order = torch.rand(self.batch, (steps - 1) * blocks, generator=generator).argsort(dim=1)
        later = order < min(round(rate * steps * blocks), order.shape[1])
        first = torch.zeros(self.batch, 1, blocks, dtype=torch.bool)
        return torch.cat([first, later.view(self.batch, steps - 1, blocks)], dim=1)

    def _calibrate_bac(self) -> Tensor:
        calibration = calibrate(self.network, self._dense, self.noise[:1], self.cond[:1])
        num_updates = min(_NUM_UPDATES, self._dense.num_inference_steps)
        top_k = min(_TOP_K, self.network.num_blocks)
        return bac_schedule(calibration, num_updates, policy="untrained", top_k=top_k).mask()
