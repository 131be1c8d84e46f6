"""Bar charts of latencies: of engine variants, and of a vision-language-action model's parts and methods."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.latency.profile import serial_share
from torchrl_sparse.evaluation.results.engine_report import EngineShape
from torchrl_sparse.evaluation.results.schema import DENSE
from torchrl_sparse.evaluation.results.text import threads_text
from torchrl_sparse.evaluation.results.vla_report import Part, VLALatency, VLAMethod

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_engine_times", "plot_thread_scaling", "plot_vla_times"]

_RUNNERS = {"eager": "#999999", "reference": "#333333", "torch": "#E69F00", "native": "#0072B2"}
_PARTS = {
    "vision towers": "#E69F00",
    "projector": "#CC79A7",
    "decoder layers": "#0072B2",
    "action head": "#009E73",
}
_REST, _MEASURED, _LIMIT, _ARITHMETIC = "#999999", "#0072B2", "#D55E00", "#009E73"


def plot_engine_times(name: str, shape: EngineShape, machine: Machine, path: str | os.PathLike) -> Path:
    """Draw the median time of every variant (log axis), with its limits from weight reads and arithmetic.

    Args:
        name: of the shape, for the title.
        shape: its entry in ``engine.json``.
        machine: what it was measured on.
        path: of the PNG.
    """
    rows = dict(sorted(shape.rows.items(), key=lambda item: -item[1].p50_s))
    times = [1e3 * row.p50_s for row in rows.values()]
    limits = {
        "memory-bandwidth limit": (_LIMIT, [1e3 * row.limit_s for row in rows.values()]),
        "f32 multiply-add limit": (_ARITHMETIC, [1e3 * (row.f32_limit_s or nan) for row in rows.values()]),
    }
    figure, axes = make_figure(9, 1.6 + 0.24 * len(rows))
    places = range(len(rows))
    axes.barh(places, times, color=[_RUNNERS[name.split()[0].split("-")[0]] for name in rows], height=0.7)
    for label, (color, values) in limits.items():
        axes.plot(values, places, "|", color=color, markersize=11, markeredgewidth=2.5, label=label)
    for place, milliseconds in zip(places, times, strict=True):
        label = f" {milliseconds:.0f}" if milliseconds >= 100 else f" {milliseconds:.3g}"
        axes.annotate(label, (milliseconds, place), va="center", fontsize=9)
    axes.set_xscale("log")
    axes.set_xlim(np.nanmin([times, *(values for _, values in limits.values())]) / 2, 2.5 * max(times))
    axes.set_yticks(places, rows, fontsize=9)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.grid(False, axis="y")
    axes.set_xlabel("time per policy call, median (ms, log scale)")
    axes.set_title(f"{name}, batch {shape.batch}; {machine.cpu}, {threads_text(shape.threads)}", loc="left")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return save_figure(figure, path)


def plot_vla_times(results: VLALatency, path: str | os.PathLike) -> Path:
    """Draw the time of each part of a dense policy call and, below, each method's measured and theoretical speed-up.

    Args:
        results: what ``vla_latency.json`` holds.
        path: of the PNG.
    """
    methods = {name: method for name, method in results.methods.items() if name != DENSE}
    figure, (above, below) = make_figure(
        9, 3.2 + 0.5 * len(methods), rows=2, columns=1, heights=(1.0, 0.6 + 0.5 * len(methods))
    )
    _draw_parts(above[0], results.parts)
    _draw_speedups(below[0], methods)
    shape, machine = results.shape, results.machine
    cpu = f"{machine.cpu}, {threads_text(machine.threads)}"
    place = machine.device if machine.device.startswith("cuda") else cpu
    figure.suptitle(f"{shape.name} shape, {shape.dtype}, batch 1; {place}", x=0.01, ha="left", fontsize=12)
    return save_figure(figure, path)


def _draw_parts(axes: Axes, parts: Mapping[str, Part]) -> None:
    left = 0.0
    for name, part in parts.items():
        width = 1e3 * part.p50_s
        color = _PARTS.get(name, _REST)
        axes.barh(0, width, left=left, color=color, height=0.6, label=f"{name} {part.share:.1%}")
        left += width
    axes.set_yticks([])
    axes.set_xlim(0, left)
    axes.set_xlabel("dense policy call, median (ms)")
    axes.legend(
        frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9, columnspacing=1.2
    )


def _draw_speedups(axes: Axes, methods: Mapping[str, VLAMethod]) -> None:
    names = list(reversed(methods))
    places = range(len(names))
    measured = [methods[name].speedup for name in names]
    expected = [methods[name].flops_speedup for name in names]
    axes.barh(places, measured, color=_MEASURED, height=0.6, label="measured")
    axes.plot(expected, places, "|", color=_LIMIT, markersize=17, markeredgewidth=3, label="by FLOPs")
    for place, name in enumerate(names):
        method = methods[name]
        text = f" {method.realised:.0%} realised, helpers {method.helper_share:.1%}"
        axes.annotate(
            text,
            (max(method.speedup, method.flops_speedup), place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
    axes.axvline(1.0, color="#333333", linewidth=1)
    axes.set_yticks(places, [f"{name}\n{methods[name].kept:.0f} tokens" for name in names], fontsize=9)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xlim(0, 1.45 * max([1.0, *measured, *expected]))
    axes.grid(False, axis="y")
    axes.set_xlabel("speed-up over dense")
    axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0, 1.0), fontsize=9)


def plot_thread_scaling(
    threads_s: Mapping[str, Mapping[str, float]], machine: Machine, path: str | os.PathLike
) -> Path:
    """Draw the speed-up of policy calls on more threads, and Amdahl's law fitted to each, up to 16.

    Args:
        threads_s: name of a call -> number of threads, as text, ``"1"`` among them -> seconds.
        machine: what it was measured on.
        path: of the PNG.
    """
    figure, axes = make_figure(7, 4.5)
    counts = np.arange(1, 17)
    axes.plot(counts, counts, ":", color=_REST, label="as many times as threads")
    for name, color in zip(threads_s, itertools.cycle((_MEASURED, _LIMIT, _ARITHMETIC)), strict=False):
        seconds = {int(count): value for count, value in threads_s[name].items()}
        share = serial_share(seconds)
        axes.plot(list(seconds), [seconds[1] / value for value in seconds.values()], "o", color=color)
        axes.plot(
            counts, 1 / (share + (1 - share) / counts), color=color, label=f"{name}, {share:.0%} serial"
        )
    axes.set_xlabel("threads")
    axes.set_ylabel("times as fast as on one thread")
    axes.set_title(f"One policy call; {machine.cpu}", loc="left")
    axes.legend(frameon=False)
    return save_figure(figure, path)
