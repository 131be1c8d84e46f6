"""First call of every variant before timing: correctness, warm-up time, and memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, Variant
from torchrl_sparse.runtime.clock import synchronised_clock

__all__ = ["FirstCall", "first_calls"]

_MOST = {"native-fp16": 1e-2, "native-bf16": 1e-1, "native-int8": 3e-1}
_MOST_F32 = 1e-4  # of sums of 100 steps in another order


@dataclass(frozen=True)
class FirstCall:
    """Time and memory of a variant's first call.

    Attributes:
        seconds: with everything that is done once: tables, compilation, captured graphs. Kinds of policy calls that share an
            engine leave what they have in common to the first of them.
        peak_bytes: of the GPU's memory beyond what the variants before hold, with the network's weights; None on a CPU.
    """

    seconds: float
    peak_bytes: int | None


def first_calls(
    case: EngineCase,
    variants: Mapping[str, Variant],
    on_call: Callable[[int, int], None] | None = None,
) -> dict[str, FirstCall]:
    """Call every variant once; print and leave out variants that cannot be compiled here.

    Args:
        case: of the variants; its reference answers each kind of policy call once, whatever the number of its variants.
        variants: by name.
        on_call: called as ``on_call(done, total)`` after each.

    Raises:
        InputError: naming the variant whose actions are not those of the reference.
    """
    first, reference = {}, cache(case.reference)
    for done, (name, variant) in enumerate(variants.items(), 1):
        try:
            first[name] = _first_call(case, name, variant, reference(variant.kind))
        except RuntimeError as error:
            if not name.startswith("eager-compiled"):
                raise
            print(f"no {name}: {str(error).splitlines()[0]}")
        if on_call is not None:
            on_call(done, len(variants))
    return first


def _first_call(case: EngineCase, name: str, variant: Variant, expected: Tensor) -> FirstCall:
    on_gpu = case.device.type == "cuda"
    others = _begin_peak(case.device) - _weight_bytes(case) if on_gpu else 0
    start = synchronised_clock(case.device)
    actions = variant.call()
    seconds = synchronised_clock(case.device) - start
    peak = torch.cuda.max_memory_allocated(case.device) - others if on_gpu else None
    error, most = (actions - expected).abs().max().item(), _MOST.get(name.split()[0], _MOST_F32)
    if not error <= most:
        raise InputError(
            f"{name}: expected the actions of the reference up to {most:g}, got a difference of {error:g}"
        )
    return FirstCall(seconds, peak)


def _begin_peak(device: torch.device) -> int:
    """Let the GPU's peak begin again; return the bytes that are taken already."""
    torch.cuda.reset_peak_memory_stats(device)
    return torch.cuda.memory_allocated(device)


def _weight_bytes(case: EngineCase) -> int:
    return sum(p.numel() * p.element_size() for p in case.network.parameters())
