"""``vla_latency.json`` and its tables: the times of a vision-language-action model's parts, and the savings of pruning."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.storage.json import read_json

__all__ = [
    "Helper",
    "Part",
    "Product",
    "VLALatency",
    "VLAMethod",
    "VLAShape",
    "format_vla_table",
    "load_vla_results",
    "vla_method_rows",
    "vla_part_rows",
    "vla_product_rows",
]

SCHEMA = 1


@dataclass(frozen=True)
class VLAShape:
    """The model: name, weights, tokens and visual tokens of a policy call, and configuration."""

    name: str
    dtype: str
    parameters: int
    tokens: int
    visual_tokens: int
    config: dict[str, Any]


@dataclass(frozen=True)
class Part:
    """One part of the dense policy call: seconds and share. The part ``"rest"`` is the untimed remainder."""

    p50_s: float
    share: float
    p10_s: float | None = None
    p90_s: float | None = None
    n: int | None = None


@dataclass(frozen=True)
class Helper:
    """Pruner's own work beside the network: seconds, and its share of the method's policy call."""

    p50_s: float
    share: float


@dataclass(frozen=True)
class VLAMethod:
    """One method. Seconds; FLOPs are 2 * MAC.

    Attributes:
        p50_s, p10_s, p90_s: percentiles of ``n`` timed policy calls.
        n: timed calls.
        flops: of a call.
        kept: visual tokens in a decoder layer, mean over the layers.
        tokens_per_layer: visual tokens in each.
        flops_speedup: dense FLOPs over the method's.
        speedup: the same of median times.
        realised: the second over the first: 1 where all FLOPs that were saved became time.
        helpers: by name; ``"choosing"`` is what comparing frames leaves of a pruner's work.
        helper_share: of all of them.
    """

    p50_s: float
    p10_s: float
    p90_s: float
    n: int
    flops: float
    kept: float
    tokens_per_layer: tuple[int, ...]
    flops_speedup: float
    speedup: float
    realised: float
    helpers: dict[str, Helper]
    helper_share: float


@dataclass(frozen=True)
class Product:
    """Matrix products alone: seconds, FLOPs (2 * MAC), and FLOPs per second."""

    p50_s: float
    flops: float
    flops_per_s: float


@dataclass(frozen=True)
class VLALatency:
    """The content of a ``vla_latency.json``, version 1; earlier ones have no ``products``."""

    schema: Literal[1]
    machine: Machine
    shape: VLAShape
    parts: dict[str, Part]
    methods: dict[str, VLAMethod]
    products: dict[str, Product] | None = None


def load_vla_results(path: str | os.PathLike) -> VLALatency:
    """Read a ``vla_latency.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is not of this schema.
    """
    return read_json(path, VLALatency)


def format_vla_table(results: VLALatency) -> str:
    """Return the parts of a dense policy call and the methods as two Markdown tables."""
    shape, machine = results.shape, results.machine
    about = (
        f"{shape.name}: {shape.parameters:,} parameters, {shape.dtype}, {shape.tokens} tokens, "
        f"{shape.visual_tokens} of them visual; {machine.device}, {machine.cpu}, threads {machine.threads}"
    )
    rows = vla_part_rows(results), vla_product_rows(results), vla_method_rows(results)
    return "\n\n".join([about, *map(markdown_table, filter(None, rows))])


def vla_part_rows(results: VLALatency) -> list[dict[str, str]]:
    """Return the rows of the parts table: column -> text."""
    return [
        {
            "part of a dense policy call": name,
            "p50, ms": f"{1e3 * part.p50_s:.2f}",
            "share": f"{part.share:.1%}",
        }
        for name, part in results.parts.items()
    ]


def vla_product_rows(results: VLALatency) -> list[dict[str, str]]:
    """Return the rows of the matrix-product table: column -> text; none if products were not timed."""
    products = results.products or {}
    best = max((product.flops_per_s for product in products.values()), default=0.0)
    return [
        {
            "products": name,
            "p50, ms": f"{1e3 * product.p50_s:.1f}",
            "GFLOP": f"{product.flops / 1e9:.3g}",
            "GFLOP/s": f"{product.flops_per_s / 1e9:.1f}",
            "of the best": f"{product.flops_per_s / best:.0%}",
        }
        for name, product in products.items()
    ]


def vla_method_rows(results: VLALatency) -> list[dict[str, str]]:
    """Return the rows of the methods table: column -> text."""
    return [_method_row(name, method) for name, method in results.methods.items()]


def _method_row(name: str, method: VLAMethod) -> dict[str, str]:
    helpers = ", ".join(f"{part} {helper.share:.1%}" for part, helper in method.helpers.items())
    return {
        "method": name,
        "visual tokens kept": f"{method.kept:.0f}",
        "p50, ms": f"{1e3 * method.p50_s:.1f}",
        "p10 – p90": f"{1e3 * method.p10_s:.1f} – {1e3 * method.p90_s:.1f}",
        "TFLOP": f"{method.flops / 1e12:.3g}",
        "speed-up": f"{method.speedup:.2f}×",
        "by FLOPs": f"{method.flops_speedup:.2f}×",
        "realised": f"{method.realised:.0%}",
        "helpers": f"{method.helper_share:.1%}{f' ({helpers})' if helpers else ''}",
    }
