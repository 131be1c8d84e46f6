"""One picture of all tasks: speed-up or compute spent, against the change in success and in time to success."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from recipes.studies.pages.result_tables import subject
from torchrl_sparse.canvas import make_figure, save_figure
from torchrl_sparse.evaluation.figures.pareto import plain_log_ticks
from torchrl_sparse.evaluation.results.schema import MethodEntry, Results
from torchrl_sparse.evaluation.statistics.differences import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

__all__ = ["plot_fronts", "plot_spending"]

Estimate = tuple[float, Interval]


@dataclass(frozen=True)
class _Family:
    """Methods of one kind, which have one colour; joined in the order of their numbers, where they have such."""

    label: str
    names: str
    color: str
    marker: str

    def members(self, methods: Iterable[str], number: Callable[[str], int]) -> list[str]:
        found = [name for name in methods if re.fullmatch(self.names, name)]
        return sorted(found, key=lambda name: -number(name))


@dataclass(frozen=True)
class _Axis:
    """What methods are drawn against.

    Attributes:
        label: of the axis.
        families: that are drawn.
        number: of a method's name, which its point is marked with; 0 for none.
        of: where a method lies; None where its results do not say.
    """

    label: str
    families: tuple[_Family, ...]
    number: Callable[[str], int]
    of: Callable[[MethodEntry], float | None]


_FAMILIES = (
    _Family("dense, other noise", "dense_noise", "#8A8A8F", "s"),
    _Family("stochastic steps", r"ddpm\d+(_logsnr)?", "#0072B2", "o"),
    _Family("deterministic steps", r"ddim\d+(_logsnr)?", "#E69F00", "^"),
    _Family("stochastic steps, 8 bits", r"ddpm\d+(_logsnr)?:int8", "#56B4E9", "o"),
    _Family("dense, 8 bits", "dense:int8", "#56B4E9", "s"),
    _Family("dense, bf16", "dense:bf16", "#B5DDF2", "s"),
    _Family("SAG", "sag", "#CC79A7", "D"),
    _Family("its mean mask", "sag_fixed", "#E7B5D0", "D"),
    _Family("L2C", "l2c", "#009E73", "v"),
    _Family("BAC", "bac", "#B2182B", "P"),
    _Family("fixed interval", "uniform7", "#4D4D4D", "X"),
    _Family("BAC on ten stochastic steps", "bac_ddpm10", "#F2A19B", "P"),
    _Family("fixed interval on them", "uniform2_ddpm10", "#A6A6AB", "X"),
    _Family("L2C on them", "l2c_type70_ddpm10", "#66C2A5", "v"),
    _Family("an observation-conditioned pruner, on them", "sag_type70_ddpm10", "#882255", "D"),
    _Family("the last two of five, from the last chunk", "ddpm5_logsnr_warm2", "#7F3C8D", "<"),
    _Family("searched mask and timesteps", "searched", "#D55E00", "*"),
    _Family("TTS", "tts", "#8C564B", "p"),
    _Family("its mean choice", "tts_fixed", "#C49C94", "p"),
    _Family("a searched choice", "recalling", "#E8C9C0", "p"),
)

_USUAL_INTERVAL = 8  # environment steps between policy calls, of all policies here
_FEW_STEPS = {2: "#56B4E9", 3: "#0072B2", 5: "#009E73", 10: "#E69F00"}
_SPENDERS = (
    _Family("dense, other noise", "dense_noise", "#8A8A8F", "s"),
    *(
        _Family(
            f"{steps} stochastic steps{label}", rf"ddpm{steps}(_logsnr)?(_every\d+)?{names}", color, marker
        )
        for steps, color in _FEW_STEPS.items()
        for label, names, marker in (("", "", "o"), (", one of eight samples", "_of8", "D"))
    ),
)


def plot_fronts(results: Sequence[Results], path: str | os.PathLike) -> Path:
    """Draw, for each task, the loss of success and time against the speed-up of a policy call over dense.

    Above is success in points, or the score; below the ratio of times to success. Bars are 95 % intervals, the dashed
    lines the margins. Methods that are of no known kind are left out. Steps of one sampler are joined and numbered.

    Args:
        results: of any number of tasks; of several of one task the first that has a method counts.
        path: of the PNG.
    """
    return _plot(results, path, _SPEED)


def plot_spending(results: Sequence[Results], path: str | os.PathLike) -> Path:
    """Draw the same loss against compute per second of robot time, for methods that replan more often or sample several chunks.

    Points are marked with the environment steps from one policy call to the next, eight where a name says nothing.

    Args:
        results, path: as of `plot_fronts`; of methods that say what an episode costs.
    """
    return _plot(results, path, _SPENT)


def _plot(results: Sequence[Results], path: str | os.PathLike, axis: _Axis) -> Path:
    tasks = _by_task(results)
    width = max(1.5 + 2.9 * len(tasks), 7.3)  # of the legend too
    figure, grid = make_figure(width, 7.2, rows=2, columns=len(tasks), sharex=True)
    handles: dict[str, Line2D] = {}
    for (title, found), upper, lower in zip(tasks.items(), *grid, strict=True):
        methods = _of_first(found)
        for family in axis.families:
            for axes, point in ((upper, _lost), (lower, _time)):
                if (line := _draw(axes, family, methods, axis, point)) is not None:
                    handles[family.label] = line
        _margins(upper, 0, -100 * found[0].dense.judged.margin)
        _margins(lower, 1, 1 + found[0].dense.time_vs_dense.margin)
        upper.set_title(title, loc="left")
        lower.set_xlabel(axis.label)
    _share_scales(*grid)
    grid[0][0].set_ylabel("success or score,\npoints over dense's")
    grid[1][0].set_ylabel("time to success over dense's,\nlog scale, less is further up")
    shown = [family.label for family in axis.families if family.label in handles]
    figure.legend(
        [handles[label] for label in shown],
        shown,
        loc="outside lower center",
        ncols=2 if len(tasks) <= 2 else 4,
        frameon=False,
        fontsize=9,
    )
    return save_figure(figure, path)


def _by_task(results: Sequence[Results]) -> dict[str, list[Results]]:
    """Return what is drawn under each title."""
    tasks: dict[str, list[Results]] = {}
    for one in results:
        title = subject(one)
        tasks.setdefault(f"{title}, score" if one.graded else title, []).append(one)
    return tasks


def _of_first(found: Sequence[Results]) -> dict[str, MethodEntry]:
    """Return the methods of all results, each of the first that has it."""
    methods: dict[str, MethodEntry] = {}
    for one in reversed(found):
        methods |= one.methods
    return methods


def _share_scales(upper: Sequence[Axes], lower: Sequence[Axes]) -> None:
    """Give all tasks the same scales, on which every point is; intervals may reach beyond."""
    shown = [[y for axes in row for line in axes.lines for y in line.get_ydata()] for row in (upper, lower)]
    for axes in upper:
        axes.set_ylim(min(shown[0]) - 4, max(shown[0]) + 7)
    low, high = min(shown[1]) / 1.15, max(shown[1]) * 1.1
    for axes in lower:
        axes.set_yscale("log")
        axes.set_ylim(high, low)
        axes.set_yticks(*plain_log_ticks(low, high))
        axes.set_xticks(*plain_log_ticks(*axes.get_xlim()))
        axes.minorticks_off()


def _lost(method: MethodEntry) -> Estimate:
    judged = method.judged
    return 100 * judged.diff, (100 * judged.ci95[0], 100 * judged.ci95[1])


def _time(method: MethodEntry) -> Estimate:
    return method.time_vs_dense.ratio, method.time_vs_dense.ci95


def _draw(
    axes: Axes,
    family: _Family,
    methods: Mapping[str, MethodEntry],
    axis: _Axis,
    point: Callable[[MethodEntry], Estimate],
) -> Line2D | None:
    """Draw the methods of a family, and return what stands for them in the legend, None where there is none."""
    where = {name: axis.of(methods[name]) for name in family.members(methods, axis.number)}
    names = [name for name, x in where.items() if x is not None]
    if not names:
        return None
    at, values = [where[name] for name in names], [point(methods[name]) for name in names]
    for x, (_, interval) in zip(at, values, strict=True):
        axes.vlines(x, *interval, color=family.color, linewidth=1.6, alpha=0.5)
    heights = [value for value, _ in values]
    (line,) = axes.plot(at, heights, f"{family.marker}-", color=family.color, markersize=6, linewidth=1)
    for name, x, y in zip(names, at, heights, strict=True):
        if number := axis.number(name):
            axes.annotate(
                f"{number}", (x, y), xytext=(5, 3), textcoords="offset points", fontsize=8, color=family.color
            )
    return line


def _steps(name: str) -> int:
    """Return the steps of a few-step chain that begins with noise, 0 of other methods.

    >>> _steps("ddpm5_logsnr:int8"), _steps("ddpm5_logsnr_warm2"), _steps("uniform2_ddpm10")
    (5, 0, 0)
    """
    found = re.match(r"dd[pi]m(\d+)(?!.*_warm)", name)
    return int(found[1]) if found else 0


def _interval(name: str) -> int:
    """Return the environment steps from one policy call of a few-step chain to the next, 0 for other methods.

    >>> _interval("ddpm3_logsnr_every2_of8"), _interval("ddpm5_logsnr"), _interval("dense_noise")
    (2, 8, 0)
    """
    found = re.search(r"_every(\d+)", name)
    return (int(found[1]) if found else _USUAL_INTERVAL) if _steps(name) else 0


def _second(method: MethodEntry) -> float | None:
    return None if method.per_episode is None else method.per_episode.flops_per_step_to_dense


def _margins(axes: Axes, dense: float, margin: float) -> None:
    axes.set_xscale("log")
    axes.axhline(dense, color="#333333", linewidth=1)
    axes.axhline(margin, color="#333333", linewidth=1, linestyle=(0, (4, 3)), alpha=0.6)


_SPEED = _Axis("times as fast as dense", _FAMILIES, _steps, lambda method: method.speedup_vs_dense)
_SPENT = _Axis("computation a second over dense's", _SPENDERS, _interval, _second)
