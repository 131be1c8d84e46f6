"""Times of every engine and of eager PyTorch on one policy's network; see `results.engine_report`."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchrl_sparse.blocks.bac import BAC
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase
from torchrl_sparse.evaluation.latency.first_calls import first_calls
from torchrl_sparse.evaluation.latency.measure import measure_latency
from torchrl_sparse.evaluation.latency.stages import example_query, stage_seconds
from torchrl_sparse.evaluation.results.engine_report import EngineShape, shape_results
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads

__all__ = ["measure_engines"]

_WHOLE = (
    "dense",
    "ddim10",
    "ddim2",
)  # kinds of policy calls of which whole calls of a policy with cameras are timed


def measure_engines(
    policy: DiffusionPolicy,
    batch: int,
    *,
    bac: BAC | None = None,
    name: str,
    repeats: int,
    warmup: int,
    threads: int | None,
    compiled: bool = False,
    instruction_sets: bool = False,
) -> EngineShape:
    """Time every engine on every kind of policy call, interleaved; for a policy with cameras, also whole calls by stage.

    Dense is DDPM in all training steps of the policy's sampler, whatever the policy takes itself.

    Args:
        policy: whose network is timed, where it is; its plan, sampler and engine play no part.
        batch: rows of a call; each has a random mask of its own where masks are random.
        bac: of the rows ``"bac10"``; None calibrates one on noise.
        name: of the case, for the progress.
        repeats, warmup: rounds, see `measure_latency`.
        threads: of PyTorch and the native engine; None leaves PyTorch's.
        compiled: also time the eager baseline under ``torch.compile``.
        instruction_sets: also time the native engine on each instruction set that this CPU has.

    Raises:
        InputError: if ``bac`` was made for another policy, or an engine answers otherwise than the reference.
    """
    dense = policy.sampler.variant()
    mask = None if bac is None else policy.with_plan(bac, dense).plan.schedule.mask()
    with num_threads(threads):
        case = EngineCase(
            policy.network,
            batch,
            dense=dense,
            compiled=compiled,
            bac_mask=mask,
            instruction_sets=instruction_sets,
        )
        variants = case.variants()
        with progress(f"{name}, first calls", "call", len(variants)) as show:
            first = first_calls(case, variants, on_call=show)
        variants = {variant: variants[variant] for variant in first}
        calls = {variant: timed.call for variant, timed in variants.items()}
        with progress(name, "round", repeats) as show:
            latency = measure_latency(calls, repeats, warmup, device=case.device, on_round=show)
        shape = shape_results(case, variants, latency, torch.get_num_threads(), first)
        if policy.vision is not None:
            shape = replace(shape, image_parts_s=_whole_calls(policy, case, repeats))
    return shape


def _whole_calls(policy: DiffusionPolicy, case: EngineCase, repeats: int) -> dict[str, dict[str, float]]:
    samplers = {kind: case.queries[kind].sampler for kind in _WHOLE if kind in case.queries}
    query = example_query(policy, case.batch)
    return {
        kind: stage_seconds(policy.with_plan(None, sampler), query, repeats)
        for kind, sampler in samplers.items()
    }
