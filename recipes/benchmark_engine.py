"""Benchmark the engines: what a query costs in the published implementation, and in ours, dense and pruned.

    python recipes/benchmark_engine.py out=outputs/engine threads=1
    python recipes/benchmark_engine.py out=outputs/engine_gpu device=cuda
    python recipes/benchmark_engine.py out=outputs/sets instruction_sets=true
    python recipes/benchmark_engine.py out=outputs/images "cases=[{shape: image, batch: 1, repeats: 15}]"

Writes OUT/engine.json, a table and a bar chart per case. Times are medians, all variants of a case interleaved in one process.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchrl_sparse.blocks.bac import BAC
from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.evaluation.figures.latency import plot_engine_times
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, make_network
from torchrl_sparse.evaluation.latency.first_calls import first_calls
from torchrl_sparse.evaluation.latency.measure import describe_machine, measure_latency
from torchrl_sparse.evaluation.latency.stages import image_policy, image_query, image_query_seconds
from torchrl_sparse.evaluation.results.engine_report import (
    SCHEMA,
    EngineResults,
    EngineShape,
    format_engine_table,
    save_engine_results,
    shape_results,
)
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.runtime.progress import progress
from torchrl_sparse.runtime.threads import num_threads

QUICK_STEPS = 20


@recipe("benchmark_engine")
def main(config: DictConfig) -> None:
    out = Path(config.out)
    on_gpu = torch.device(config.device).type == "cuda"
    results = EngineResults(SCHEMA, describe_machine(config.device, config.threads), {})
    for entry in config.gpu_cases if on_gpu else config.cases:
        name = f"{entry.shape}_b{entry.batch}"
        with num_threads(config.threads):
            results.shapes[name] = run_case(name, entry, config)
        # After each case, so that a run that is stopped leaves what it has.
        save_engine_results(results, out / "engine.json")
        shape = results.shapes[name]
        plot_engine_times(name, shape, results.machine, out / f"engine_{name}.png")
        print(f"\n{format_engine_table(name, shape)}\n")
    print(f"files are in {out}")


def run_case(name: str, entry: DictConfig, config: DictConfig) -> EngineShape:
    network, bac_mask = make_network(entry.shape, quick=config.quick), None
    if entry.shape == "low_dim" and config.policy is not None and not config.quick:
        network, bac_mask = load_trained(Path(config.policy))
    network.to(config.device)
    # Compiling takes minutes and changes nothing with the batch, so one case shows it.
    compiled = config.compile and not config.quick and entry.get("compile", False)
    case = EngineCase(
        network,
        entry.batch,
        num_steps=QUICK_STEPS if config.quick else 100,
        compiled=compiled,
        bac_mask=bac_mask,
        instruction_sets=config.instruction_sets,
    )
    variants = case.variants()
    with progress(f"{name}, first calls", "call", len(variants)) as show:
        first = first_calls(case, variants, on_call=show)
    variants = {variant: variants[variant] for variant in first}
    repeats = 1 if config.quick else entry.repeats
    with progress(name, "round", repeats) as show:
        latency = measure_latency(
            {variant: case_variant.call for variant, case_variant in variants.items()},
            repeats=repeats,
            warmup=1 if config.quick else config.warmup,
            device=config.device,
            on_round=show,
        )
    shape = shape_results(case, variants, latency, config.threads, first)
    if entry.shape == "image":
        shape = replace(shape, image_parts_s=image_parts(case, config.quick, repeats))
    return shape


def image_parts(case: EngineCase, quick: bool, repeats: int) -> dict[str, dict[str, float]]:
    """Time whole queries of an image policy, dense and of few steps."""
    policy = image_policy(case.network, width=16 if quick else 64, sampler=case.queries["dense"].sampler)
    seconds = {}
    for kind in ("dense", "ddim10", "ddim2"):
        policy.sampler = case.queries[kind].sampler
        seconds[kind] = image_query_seconds(policy, image_query(policy, case.batch), repeats)
    return seconds


def load_trained(folder: Path) -> tuple[TransformerForDiffusion, Tensor]:
    """Load a policy's network and the mask of its BAC schedule, which is refused if it was made for another policy."""
    policy = DiffusionPolicy.from_pretrained(folder)
    policy.plan = BAC.from_pretrained(folder / "bac.json")
    return policy.network, policy.plan.schedule.mask()


if __name__ == "__main__":
    main()
