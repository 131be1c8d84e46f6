"""``vla_latency.json``, its table and its chart: where a vision-language-action model spends its time, and what pruning saves.

Schema version 1 (seconds; FLOPs are 2 * MAC)::

    {"schema": 1,
     "machine": {"cpu": str, "threads": int, "device": str, "torch": str, "date": str},
     "shape": {"name": str, "dtype": str, "parameters": int, "tokens": int, "visual_tokens": int, "config": {...}},
     "parts": {PART: {"p50_s", "p10_s", "p90_s", "n", "share"}},
     "methods": {METHOD: {"p50_s", "p10_s", "p90_s", "n", "flops": float, "kept": float, "tokens_per_layer": [int, ...],
                          "flops_speedup": float, "speedup": float, "realised": float,
                          "helpers": {HELPER: {"p50_s", "share"}}, "helper_share": float}}}

``share`` is a part's of the dense query, and a helper's of its own method's query; the part ``"rest"`` is what the others leave
of the dense query, ``"choosing"`` what comparing frames leaves of a pruner's work. ``flops_speedup`` is dense FLOPs over the
method's, ``speedup`` the same of median times, and ``realised`` the second over the first: 1 where all FLOPs that were saved
became time.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_sparse import keys
from torchrl_sparse.evaluation.figures.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.latency.measure import Latency, measure_latency
from torchrl_sparse.evaluation.latency.vla_cases import VLACase
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import read_json

__all__ = ["format_vla_table", "measure_vla", "plot_vla_times", "save_vla_results"]

DENSE = "dense"
_PARTS = {
    "vision towers": "#E69F00",
    "projector": "#CC79A7",
    "decoder layers": "#0072B2",
    "action head": "#009E73",
}
_REST, _MEASURED, _FLOPS = "#999999", "#0072B2", "#D55E00"


def measure_vla(
    case: VLACase,
    *,
    repeats: int,
    warmup: int = 2,
    on_round: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """``"shape"`` (but for its name), ``"parts"`` and ``"methods"`` of ``vla_latency.json``, everything interleaved.

    Args:
        case: with a method ``"dense"``.
        repeats, warmup, on_round: see `measure_latency`.
    """
    pruned = [name for name, policy in case.policies.items() if policy.pruner is not None]
    calls = {("parts", name): call for name, call in case.parts().items()}
    calls |= {("query", name): lambda name=name: case.answer(name) for name in case.policies}
    calls |= {(method, name): call for method in pruned for name, call in case.helpers(method).items()}
    weight = next(case.network.parameters())
    latency = measure_latency(calls, repeats, warmup, device=weight.device, on_round=on_round)
    config = case.network.config
    return {
        "shape": {
            "dtype": str(weight.dtype).removeprefix("torch."),
            "parameters": sum(parameter.numel() for parameter in case.network.parameters()),
            "tokens": case.sequence().hidden.shape[1],
            "visual_tokens": config.num_visual,
            "config": config.to_dict(),
        },
        "parts": _parts(latency),
        "methods": {name: _method(name, case, latency) for name in case.policies},
    }


def _parts(latency: Mapping[tuple[str, str], Latency]) -> dict[str, Any]:
    whole = latency["query", DENSE].p50
    parts = {name: _row(times) for (kind, name), times in latency.items() if kind == "parts"}
    parts["rest"] = {"p50_s": max(0.0, whole - sum(row["p50_s"] for row in parts.values()))}
    return {name: {**row, "share": row["p50_s"] / whole} for name, row in parts.items()}


def _method(name: str, case: VLACase, latency: Mapping[tuple[str, str], Latency]) -> dict[str, Any]:
    answer, dense = case.answer(name), case.answer(DENSE)
    own, flops = latency["query", name], answer[keys.FLOPS].item()
    expected, speedup = dense[keys.FLOPS].item() / flops, latency["query", DENSE].p50 / own.p50
    depth = answer[keys.TOKEN_DEPTH]
    helpers = _helpers(
        {part: times.p50 for (method, part), times in latency.items() if method == name}, own.p50
    )
    return {
        **_row(own),
        "flops": flops,
        "kept": answer[keys.KEPT].item(),
        "tokens_per_layer": [int((depth > layer).sum()) for layer in range(case.network.config.llm.layers)],
        "flops_speedup": expected,
        "speedup": speedup,
        "realised": speedup / expected,
        "helpers": helpers,
        "helper_share": sum(helper["share"] for helper in helpers.values()),
    }


def _helpers(seconds: dict[str, float], query: float) -> dict[str, Any]:
    if "comparing" in seconds:
        seconds["choosing"] = max(0.0, seconds["choosing"] - seconds["comparing"])
    return {name: {"p50_s": value, "share": value / query} for name, value in seconds.items()}


def _row(latency: Latency) -> dict[str, Any]:
    p10, p90 = np.percentile(latency.samples, [10, 90])
    return {"p50_s": latency.p50, "p10_s": float(p10), "p90_s": float(p90), "n": latency.n}


def save_vla_results(results: Mapping[str, Any], path: str | os.PathLike) -> None:
    """Write ``vla_latency.json``, in one piece or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")


def load_vla_results(path: str | os.PathLike) -> dict[str, Any]:
    """Read a ``vla_latency.json``."""
    return read_json(path, dict[str, Any])


def format_vla_table(results: Mapping[str, Any]) -> str:
    """The parts of a dense query and the methods, as two tables in Markdown."""
    shape, machine = results["shape"], results["machine"]
    about = (
        f"{shape['name']}: {shape['parameters']:,} parameters, {shape['dtype']}, {shape['tokens']} tokens, "
        f"{shape['visual_tokens']} of them visual; {machine['device']}, {machine['cpu']}, threads {machine['threads']}"
    )
    tables = markdown_table(vla_part_rows(results)), markdown_table(vla_method_rows(results))
    return "\n\n".join([about, *tables])


def vla_part_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the rows of the table of parts: column -> text."""
    return [
        {
            "part of a dense query": name,
            "p50, ms": f"{1e3 * row['p50_s']:.2f}",
            "share": f"{row['share']:.1%}",
        }
        for name, row in results["parts"].items()
    ]


def vla_method_rows(results: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the rows of the table of methods: column -> text."""
    return [_method_row(name, row) for name, row in results["methods"].items()]


def _method_row(name: str, row: Mapping[str, Any]) -> dict[str, str]:
    helpers = ", ".join(f"{part} {helper['share']:.1%}" for part, helper in row["helpers"].items())
    return {
        "method": name,
        "visual tokens kept": f"{row['kept']:.0f}",
        "p50, ms": f"{1e3 * row['p50_s']:.1f}",
        "p10 – p90": f"{1e3 * row['p10_s']:.1f} – {1e3 * row['p90_s']:.1f}",
        "TFLOP": f"{row['flops'] / 1e12:.3g}",
        "speed-up": f"{row['speedup']:.2f}×",
        "by FLOPs": f"{row['flops_speedup']:.2f}×",
        "realised": f"{row['realised']:.0%}",
        "helpers": f"{row['helper_share']:.1%}{f' ({helpers})' if helpers else ''}",
    }


def plot_vla_times(results: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Above, what a dense query spends its time on; below, every method's speed-up beside what its FLOPs promise.

    Args:
        results: what ``vla_latency.json`` holds.
        path: of the PNG.
    """
    methods = {name: row for name, row in results["methods"].items() if name != DENSE}
    figure, (above, below) = make_figure(
        9, 3.2 + 0.5 * len(methods), rows=2, columns=1, heights=(1.0, 0.6 + 0.5 * len(methods))
    )
    _draw_parts(above[0], results)
    _draw_speedups(below[0], methods)
    shape, machine = results["shape"], results["machine"]
    threads = f"{machine['threads']} thread{'' if machine['threads'] == 1 else 's'}"
    place = machine["device"] if machine["device"].startswith("cuda") else f"{machine['cpu']}, {threads}"
    figure.suptitle(
        f"{shape['name']} shape, {shape['dtype']}, batch 1; {place}", x=0.01, ha="left", fontsize=12
    )
    return save_figure(figure, path)


def _draw_parts(axes: Any, results: Mapping[str, Any]) -> None:
    left = 0.0
    for name, row in results["parts"].items():
        width = 1e3 * row["p50_s"]
        color = _PARTS.get(name, _REST)
        axes.barh(0, width, left=left, color=color, height=0.6, label=f"{name} {row['share']:.1%}")
        left += width
    axes.set_yticks([])
    axes.set_xlim(0, left)
    axes.set_xlabel("dense query, median (ms)")
    axes.legend(
        frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9, columnspacing=1.2
    )


def _draw_speedups(axes: Any, methods: Mapping[str, Any]) -> None:
    names = list(reversed(methods))
    places = range(len(names))
    measured = [methods[name]["speedup"] for name in names]
    expected = [methods[name]["flops_speedup"] for name in names]
    axes.barh(places, measured, color=_MEASURED, height=0.6, label="measured")
    axes.plot(expected, places, "|", color=_FLOPS, markersize=17, markeredgewidth=3, label="by FLOPs")
    for place, name in enumerate(names):
        row = methods[name]
        text = f" {row['realised']:.0%} realised, helpers {row['helper_share']:.1%}"
        axes.annotate(
            text,
            (max(row["speedup"], row["flops_speedup"]), place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
    axes.axvline(1.0, color="#333333", linewidth=1)
    axes.set_yticks(places, [f"{name}\n{methods[name]['kept']:.0f} tokens" for name in names], fontsize=9)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlim(0, 1.45 * max([1.0, *measured, *expected]))
    axes.grid(False, axis="y")
    axes.set_xlabel("speed-up over dense")
    axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9)
