"""``engine.json``, its table and its bar charts: how fast each engine answers each kind of query.

Schema version 1 (seconds; ``null`` where there is nothing to compare)::

    {"schema": 1,
     "machine": {"cpu": str, "threads": int, "device": str, "torch": str, "date": str},
     "shapes": {NAME: {
        "threads": int, "batch": int,
        "bandwidth_gb_per_s": float, "f32_gflops_per_s": float,
        "rows": {VARIANT: {"p50_s": float, "p10_s": float, "p90_s": float, "n": int,
                           "x_eager": float, "x_dense": float, "max_err": float, "limit_s": float, "f32_limit_s": float}},
        "program_build_s": float,
        "all_pruned_step_s": {RUNNER: float}}}}

``x_eager`` and ``x_dense`` are ratios of medians, to the eager baseline and to the dense query of the same runner;
``max_err`` is the largest difference of a normalised action to the reference's, on the same noise and mask. ``limit_s`` is what
reading the weights of all computed blocks takes, once per evaluation, at ``bandwidth_gb_per_s``: the rate at which one thread
reads an array as large as those weights, again and again. ``f32_limit_s`` is what multiplying with these weights takes, for
every row that computes them, at ``f32_gflops_per_s``: the rate of PyTorch's product of two large matrices; ``null`` for bf16.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Mapping
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_sparse.blocks.engine.program import build_program
from torchrl_sparse.blocks.engine.torch.linear import make_linear
from torchrl_sparse.evaluation.figures.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, Variant
from torchrl_sparse.evaluation.latency.measure import Latency
from torchrl_sparse.evaluation.results.tables import markdown_table, select_columns
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import read_json

__all__ = [
    "format_engine_table",
    "measure_bandwidth",
    "measure_multiply_adds",
    "plot_engine_times",
    "program_seconds",
    "save_engine_results",
    "shape_results",
]

_COLUMNS = ("variant", "p50, ms", "p10 – p90", "× eager", "× own dense", "max error")
_COLORS = {"eager": "#999999", "reference": "#333333", "torch": "#E69F00", "native": "#0072B2"}


def block_weights(network: TransformerForDiffusion) -> tuple[int, int, int]:
    """Weights that one SA, CA and FFN block must read; folded cross-attention reads next to nothing."""
    width = network.n_emb
    return 4 * width * width, 0, 8 * width * width


def measure_bandwidth(network: TransformerForDiffusion, repeats: int = 20) -> float:
    """Bytes per second at which this thread reads as much as one denoising step's weights, the best of ``repeats``."""
    size = network.n_layer * sum(block_weights(network))
    array, best = torch.ones(size), float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        array.sum()
        best = min(best, time.perf_counter() - start)
    return 4 * size / best


def measure_multiply_adds(size: int = 1536, repeats: int = 5) -> float:
    """FLOPs (2 * MAC) per second of a large product of f32 matrices in PyTorch, the best of ``repeats``.

    Of the two libraries that PyTorch may have for it the faster one counts: on AMD's CPUs MKL's vectors are half as wide as
    oneDNN's.
    """
    matrix, out, best = torch.ones(size, size), torch.ones(size, size), float("inf")
    for product in (torch.mm, make_linear(matrix, torch.zeros(size))):
        for _ in range(repeats):
            start = time.perf_counter()
            product(matrix, out)
            best = min(best, time.perf_counter() - start)
    return 2 * size**3 / best


def program_seconds(case: EngineCase, repeats: int = 50) -> float:
    """Median seconds that the program of a new random mask takes to build."""
    mask = case.queries["random91"].mask[0].numpy()
    samples = []
    for _ in range(repeats):
        start = time.perf_counter()
        build_program(mask)
        samples.append(time.perf_counter() - start)
    return statistics.median(samples)


def shape_results(
    case: EngineCase, variants: Mapping[str, Variant], latency: Mapping[str, Latency], threads: int
) -> dict[str, Any]:
    """The entry of one shape in ``engine.json``.

    Args:
        case: what was run.
        variants: its variants.
        latency: of each of them, measured interleaved.
        threads: that were used.
    """
    bandwidth, multiply_adds = measure_bandwidth(case.network), measure_multiply_adds()
    expected = {kind: case.reference(kind) for kind in case.queries}
    rows = {}
    for name, variant in variants.items():
        samples = latency[name].samples
        rows[name] = {
            "p50_s": latency[name].p50,
            "p10_s": float(np.percentile(samples, 10)),
            "p90_s": float(np.percentile(samples, 90)),
            "n": latency[name].n,
            "x_eager": latency["eager dense"].p50 / latency[name].p50,
            "x_dense": latency[variant.dense].p50 / latency[name].p50,
            "max_err": (variant.call() - expected[variant.kind]).abs().max().item(),
            "limit_s": _bytes_read(case, variant) / bandwidth,
            "f32_limit_s": _product_flops(case, variant) / multiply_adds if variant.in_f32 else None,
        }
    return {
        "threads": threads,
        "batch": case.batch,
        "bandwidth_gb_per_s": bandwidth / 1e9,
        "f32_gflops_per_s": multiply_adds / 1e9,
        "rows": rows,
        "program_build_s": program_seconds(case),
        "all_pruned_step_s": _all_pruned_steps(case, rows),
    }


def _bytes_read(case: EngineCase, variant: Variant) -> int:
    query = case.queries[variant.kind]
    evaluations = query.evaluations()
    count = query.sampler.num_inference_steps if evaluations is None else evaluations
    return variant.weight_bytes * int((_all_weights(case) * count).sum())


def _product_flops(case: EngineCase, variant: Variant) -> int:
    count = case.queries[variant.kind].row_evaluations(case.batch)
    return 2 * case.network.horizon * int((_all_weights(case) * count).sum())


def _all_weights(case: EngineCase) -> torch.Tensor:
    return torch.tensor(block_weights(case.network)).repeat(case.network.n_layer)


def _all_pruned_steps(case: EngineCase, rows: Mapping[str, Any]) -> dict[str, float]:
    """Seconds of a step that computes nothing, per runner: what all of them take beyond a query of one dense step."""
    steps = case.queries["dense"].sampler.num_inference_steps
    runners = [name.split()[0] for name in rows if name.endswith(" all-pruned")]
    return {
        runner: (rows[f"{runner} all-pruned"]["p50_s"] - rows[f"{runner} ddim1"]["p50_s"]) / (steps - 1)
        for runner in runners
    }


def save_engine_results(results: Mapping[str, Any], path: str | os.PathLike) -> None:
    """Write ``engine.json``, in one piece or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")


def load_engine_results(path: str | os.PathLike) -> dict[str, Any]:
    """Read an ``engine.json``."""
    return read_json(path, dict[str, Any])


def format_engine_table(name: str, shape: Mapping[str, Any]) -> str:
    """The rows of one shape as a table in Markdown."""
    head = (
        f"{name}: batch {shape['batch']}, threads {shape['threads']}, "
        f"weights read at {shape['bandwidth_gb_per_s']:.1f} GB/s, "
        f"products of {shape['f32_gflops_per_s']:.0f} GFLOP/s, "
        f"program built in {1e3 * shape['program_build_s']:.2f} ms"
    )
    table = markdown_table(select_columns(engine_rows(shape), _COLUMNS))
    steps = [f"{1e6 * seconds:.1f} µs in {name}" for name, seconds in shape["all_pruned_step_s"].items()]
    return "\n\n".join([head, table, f"A step that computes nothing takes {', '.join(steps)}."])


def engine_rows(shape: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return one row of text per variant, also with what its memory and its arithmetic take alone."""
    return [_engine_row(variant, row) for variant, row in shape["rows"].items()]


def _engine_row(variant: str, row: Mapping[str, Any]) -> dict[str, str]:
    arithmetic = row["f32_limit_s"]
    return {
        "variant": variant,
        "p50, ms": f"{1e3 * row['p50_s']:.1f}",
        "p10 – p90": f"{1e3 * row['p10_s']:.1f} – {1e3 * row['p90_s']:.1f}",
        "× eager": f"{row['x_eager']:.1f}",
        "× own dense": f"{row['x_dense']:.1f}",
        "max error": f"{row['max_err']:.1e}",
        "memory alone, ms": f"{1e3 * row['limit_s']:.1f}",
        "f32 arithmetic alone, ms": "" if arithmetic is None else f"{1e3 * arithmetic:.1f}",
    }


def plot_engine_times(
    name: str, shape: Mapping[str, Any], machine: Mapping[str, Any], path: str | os.PathLike
) -> Path:
    """Median time of every variant as a bar (log axis), and what reading its weights or multiplying with them would take.

    Args:
        name: of the shape, for the title.
        shape: its entry in ``engine.json``.
        machine: what it was measured on.
        path: of the PNG.
    """
    rows = shape["rows"]
    names = sorted(rows, key=lambda variant: -rows[variant]["p50_s"])
    times = [1e3 * rows[variant]["p50_s"] for variant in names]
    limits = {
        "memory-bandwidth limit": ("#D55E00", [1e3 * rows[variant]["limit_s"] for variant in names]),
        "f32 multiply-add limit": (
            "#009E73",
            [1e3 * (rows[variant]["f32_limit_s"] or nan) for variant in names],
        ),
    }
    figure, axes = make_figure(9, 1.6 + 0.24 * len(names))
    places = range(len(names))
    axes.barh(
        places, times, color=[_COLORS[variant.split()[0].split("-")[0]] for variant in names], height=0.7
    )
    for label, (color, values) in limits.items():
        axes.plot(values, places, "|", color=color, markersize=11, markeredgewidth=2.5, label=label)
    for place, milliseconds in zip(places, times, strict=True):
        label = f" {milliseconds:.0f}" if milliseconds >= 100 else f" {milliseconds:.3g}"
        axes.annotate(label, (milliseconds, place), va="center", fontsize=9)
    axes.set_xscale("log")
    axes.set_xlim(np.nanmin([times, *(values for _, values in limits.values())]) / 2, 2.5 * max(times))
    axes.set_yticks(places, names, fontsize=9)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.grid(False, axis="y")
    axes.set_xlabel("time per query, median (ms, log scale)")
    threads = f"{shape['threads']} thread{'' if shape['threads'] == 1 else 's'}"
    axes.set_title(f"{name}, batch {shape['batch']}; {machine['cpu']}, {threads}", loc="left")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return save_figure(figure, path)
