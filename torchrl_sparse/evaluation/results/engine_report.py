"""``engine.json`` and its table: the time of each engine for each kind of policy call."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, Variant
from torchrl_sparse.evaluation.latency.first_calls import FirstCall
from torchrl_sparse.evaluation.latency.limits import (
    block_weights,
    measure_bandwidth,
    measure_multiply_adds,
    program_seconds,
)
from torchrl_sparse.evaluation.latency.measure import Latency, Machine
from torchrl_sparse.evaluation.results.tables import markdown_table, select_columns
from torchrl_sparse.storage.json import read_json

__all__ = [
    "EngineResults",
    "EngineRow",
    "EngineShape",
    "engine_rows",
    "format_engine_table",
    "image_part_rows",
    "load_engine_results",
    "shape_results",
]

SCHEMA = 1
GPU_COLUMNS = ("first call, ms", "peak memory, MB")
COLUMNS = ("variant", "p50, ms", "p10 – p90", "× eager", "× own dense", "max error")


@dataclass(frozen=True)
class EngineRow:
    """One engine variant on one kind of policy call. Seconds.

    Attributes:
        p50_s, p10_s, p90_s: percentiles of ``n`` timed calls.
        n: timed calls.
        x_eager: how many times as fast as the dense call of the eager baseline, a ratio of medians.
        x_dense: the same of the dense call of the same runner.
        max_err: largest difference of a normalised action to the reference's, on the same noise and mask.
        limit_s: what reading the weights of all computed blocks takes, once per evaluation, at the shape's bandwidth.
        f32_limit_s: what multiplying with these weights takes, for every row that computes them, at the shape's rate of
            products; None for bf16 and int8.
        first_s: of the first call, with everything that is done once; None in older files.
        peak_bytes: that the first call took of a GPU's memory, with the weights; None on a CPU.
    """

    p50_s: float
    p10_s: float
    p90_s: float
    n: int
    x_eager: float
    x_dense: float
    max_err: float
    limit_s: float
    f32_limit_s: float | None
    first_s: float | None = None
    peak_bytes: int | None = None


@dataclass(frozen=True)
class EngineShape:
    """All variants of one network at one batch size.

    Attributes:
        threads: that were used.
        batch: rows of a policy call.
        bandwidth_gb_per_s: at which one thread reads an array as large as a step's weights, again and again.
        f32_gflops_per_s: of PyTorch's product of two large matrices.
        rows: by the name of the variant, ``"<runner> <kind>"``.
        program_build_s: that the program of a new mask takes to build.
        all_pruned_step_s: of a step that computes nothing, by runner.
        image_parts_s: of whole calls of an image policy: sampler -> part -> seconds, see `stage_seconds`; None
            elsewhere.
    """

    threads: int
    batch: int
    bandwidth_gb_per_s: float
    f32_gflops_per_s: float
    rows: dict[str, EngineRow]
    program_build_s: float
    all_pruned_step_s: dict[str, float]
    image_parts_s: dict[str, dict[str, float]] | None = None


@dataclass(frozen=True)
class EngineResults:
    """The content of an ``engine.json``, version 1."""

    schema: Literal[1]
    machine: Machine
    shapes: dict[str, EngineShape]


def shape_results(
    case: EngineCase,
    variants: Mapping[str, Variant],
    latency: Mapping[str, Latency],
    threads: int,
    first: Mapping[str, FirstCall] | None = None,
) -> EngineShape:
    """Combine the measurements of one case with the machine's measured limits.

    Args:
        case: what was run.
        variants: its variants.
        latency: of each of them, measured interleaved.
        threads: that were used.
        first: the first call of each of them, if it was watched.
    """
    bandwidth, multiply_adds = measure_bandwidth(case.network), measure_multiply_adds(device=case.device)
    expected = {kind: case.reference(kind) for kind in case.queries}
    rows = {}
    for name, variant in variants.items():
        p10, p90 = np.percentile(latency[name].samples, [10, 90])
        rows[name] = EngineRow(
            p50_s=latency[name].p50,
            p10_s=float(p10),
            p90_s=float(p90),
            n=latency[name].n,
            x_eager=latency["eager dense"].p50 / latency[name].p50,
            x_dense=latency[variant.dense].p50 / latency[name].p50,
            max_err=(variant.call() - expected[variant.kind]).abs().max().item(),
            limit_s=_bytes_read(case, variant) / bandwidth,
            f32_limit_s=_product_flops(case, variant) / multiply_adds if variant.in_f32 else None,
            first_s=first[name].seconds if first else None,
            peak_bytes=first[name].peak_bytes if first else None,
        )
    return EngineShape(
        threads=threads,
        batch=case.batch,
        bandwidth_gb_per_s=bandwidth / 1e9,
        f32_gflops_per_s=multiply_adds / 1e9,
        rows=rows,
        program_build_s=program_seconds(case),
        all_pruned_step_s=_all_pruned_steps(case, rows),
    )


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


def _all_pruned_steps(case: EngineCase, rows: Mapping[str, EngineRow]) -> dict[str, float]:
    """Return the seconds of a step that computes nothing, per runner: what all take beyond a policy call of one dense step."""
    steps = case.queries["dense"].sampler.num_inference_steps
    runners = [name.split()[0] for name in rows if name.endswith(" all-pruned")]
    return {
        runner: (rows[f"{runner} all-pruned"].p50_s - rows[f"{runner} ddim1"].p50_s) / (steps - 1)
        for runner in runners
    }


def load_engine_results(path: str | os.PathLike) -> EngineResults:
    """Read an ``engine.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is not of this schema.
    """
    return read_json(path, EngineResults)


def format_engine_table(name: str, shape: EngineShape) -> str:
    """Return one shape's rows as a Markdown table with explanations above and below."""
    head = (
        f"{name}: batch {shape.batch}, threads {shape.threads}, "
        f"weights read at {shape.bandwidth_gb_per_s:.1f} GB/s, "
        f"products of {shape.f32_gflops_per_s:.0f} GFLOP/s, "
        f"program built in {1e3 * shape.program_build_s:.2f} ms"
    )
    on_gpu = any(row.peak_bytes is not None for row in shape.rows.values())
    table = markdown_table(select_columns(engine_rows(shape), COLUMNS + GPU_COLUMNS * on_gpu))
    steps = [f"{1e6 * seconds:.1f} µs in {name}" for name, seconds in shape.all_pruned_step_s.items()]
    text = [head, table, f"A step that computes nothing takes {', '.join(steps)}."]
    if shape.image_parts_s:
        text += [
            "Whole policy calls, cameras included.",
            markdown_table(image_part_rows(shape.image_parts_s)),
        ]
    return "\n\n".join(text)


def image_part_rows(parts_s: Mapping[str, Mapping[str, float]]) -> list[dict[str, str]]:
    """Return one row of text per part of an image policy's call: its time and its share by sampler."""
    rows = []
    for part in next(iter(parts_s.values())):
        row = {"part": part}
        for sampler, seconds in parts_s.items():
            row[f"{sampler}, ms"] = f"{1e3 * seconds[part]:.2f}"
            row[f"{sampler}, share"] = f"{seconds[part] / seconds['query']:.0%}"
        rows.append(row)
    return rows


def engine_rows(shape: EngineShape) -> list[dict[str, str]]:
    """Return one row of text per variant: the table's columns, and its limits from memory and arithmetic."""
    return [_engine_row(variant, row) for variant, row in shape.rows.items()]


def _engine_row(variant: str, row: EngineRow) -> dict[str, str]:
    return {
        "variant": variant,
        "p50, ms": f"{1e3 * row.p50_s:.1f}",
        "p10 – p90": f"{1e3 * row.p10_s:.1f} – {1e3 * row.p90_s:.1f}",
        "× eager": f"{row.x_eager:.1f}",
        "× own dense": f"{row.x_dense:.1f}",
        "max error": f"{row.max_err:.1e}",
        "memory alone, ms": f"{1e3 * row.limit_s:.1f}",
        "f32 arithmetic alone, ms": "" if row.f32_limit_s is None else f"{1e3 * row.f32_limit_s:.1f}",
        "first call, ms": "" if row.first_s is None else f"{1e3 * row.first_s:.1f}",
        "peak memory, MB": "" if row.peak_bytes is None else f"{row.peak_bytes / 1e6:.0f}",
    }
