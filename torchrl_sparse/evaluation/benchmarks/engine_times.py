"""Times of every engine and of eager PyTorch on one policy's network; see `results.engine_report`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrl_sparse.blocks.bac import BAC
from torchrl_sparse.evaluation.figures.latency import plot_engine_times
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase
from torchrl_sparse.evaluation.latency.first_calls import first_calls
from torchrl_sparse.evaluation.latency.measure import describe_machine, measure_latency
from torchrl_sparse.evaluation.latency.stages import example_query, stage_seconds
from torchrl_sparse.evaluation.results.engine_report import (
    SCHEMA,
    EngineResults,
    EngineShape,
    format_engine_table,
    shape_results,
)
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads
from torchrl_sparse.storage.json import write_json

__all__ = ["measure_engines", "profile_engines"]

_WHOLE = (
    "dense",
    "ddim10",
    "ddim2",
)  # kinds of policy calls of which whole calls of a policy with cameras are timed


def profile_engines(
    policy: DiffusionPolicy,
    out: str | Path,
    *,
    name: str,
    batches: Sequence[int],
    compile: bool,
    **options: Any,
) -> None:
    """Measure, print and draw every engine at each batch; ``engine.json`` in ``out`` is written after each.

    Args:
        policy: on the device of the engines.
        out: folder of the files.
        name: of the policy or the shape.
        batches: rows of a query.
        compile: also time the eager baseline under torch.compile, at the first batch.
        options: of `measure_engines`.
    """
    results = EngineResults(SCHEMA, describe_machine(str(policy.device), options["threads"]), {})
    for number, batch in enumerate(batches):
        at = f"{name}_b{batch}"
        # Compiling takes minutes and changes nothing with the batch, so the first one shows it.
        shape = measure_engines(policy, batch, name=at, compiled=compile and number == 0, **options)
        results.shapes[at] = shape
        # After each, so that a run that is stopped leaves what it has.
        write_json(Path(out, "engine.json"), results)
        plot_engine_times(at, shape, results.machine, Path(out, f"engine_{at}.png"))
        print(f"\n{format_engine_table(at, shape)}")


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
