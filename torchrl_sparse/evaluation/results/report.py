"""From what was measured of a benchmark to its `Results`, and from there to the table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from torchrl_sparse.evaluation.latency.measure import Latency, Machine
from torchrl_sparse.evaluation.results.schema import (
    DENSE,
    SCHEMA,
    ActionError,
    Difference,
    Flops,
    MethodEntry,
    Percentiles,
    PolicyShape,
    Results,
    Success,
    TokensKept,
)
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import (
    count_text,
    difference_text,
    milliseconds_text,
    points_text,
    threads_text,
)
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult, token_totals, totals
from torchrl_sparse.evaluation.statistics.intervals import (
    DEFAULT_MARGIN,
    PairedDifference,
    episodes_needed,
    paired_difference,
)

__all__ = [
    "MethodRun",
    "build_results",
    "format_pairs",
    "format_table",
    "pair_rows",
    "results_note",
    "results_rows",
]


@dataclass(frozen=True)
class MethodRun:
    """Everything measured of one method.

    Attributes:
        episodes: its episodes, the same seeds as every other method's, in any order.
        latency: of one query, measured interleaved with the other methods.
        action_error: (mean, maximum) absolute difference of its chunks to the dense policy's, on the same
            observations and the same noise; (0, 0) for the dense policy.
        planning: of the planner alone, within a query; where it looks at the observation.
    """

    episodes: Sequence[EpisodeResult]
    latency: Latency
    action_error: tuple[float, float]
    planning: Latency | None = None


def build_results(
    runs: Mapping[str, MethodRun],
    *,
    task: str,
    seed: int,
    machine: Machine,
    policy: PolicyShape,
    margin: float = DEFAULT_MARGIN,
) -> Results:
    """Make the content of ``results.json`` from what was measured.

    Args:
        runs: method name -> its run; ``"dense"``, which all are compared with, must be there.
        task: name of the task.
        seed: of the whole benchmark.
        machine: see `describe_machine`.
        policy: the dense policy.
        margin: non-inferiority margin of the verdicts, a difference of success rates.

    Raises:
        ValueError: if dense is missing, methods ran on different seeds, or a value is out of range.
    """
    if DENSE not in runs:
        raise ValueError(f"runs: expected the method {DENSE!r} among them, got {sorted(runs)}")
    methods = {name: _entry(name, run, runs[DENSE], margin) for name, run in runs.items()}
    return Results(SCHEMA, task, seed, machine, policy, methods)


def _entry(name: str, run: MethodRun, dense: MethodRun, margin: float) -> MethodEntry:
    outcomes, paired = _compare(name, run, dense, margin)
    cost, tokens = totals(run.episodes), token_totals(run.episodes)
    return MethodEntry(
        success=Success.of(outcomes),
        paired_vs_dense=Difference.of(paired),
        prune_rate=cost.prune_rate,
        flops=Flops(cost.flops_per_query, cost.flops_per_query / totals(dense.episodes).flops_per_query),
        latency_s=Percentiles.of(run.latency),
        speedup_vs_dense=dense.latency.p50 / run.latency.p50,
        action_error_vs_dense=ActionError(*map(float, run.action_error)),
        episode_length=cost.episode_length,
        planning_s=None if run.planning is None else Percentiles.of(run.planning),
        tokens=None if tokens is None else TokensKept(tokens.mean, tokens.fine, tokens.coarse),
    )


def _compare(
    name: str, run: MethodRun, dense: MethodRun, margin: float
) -> tuple[list[bool], PairedDifference]:
    ours, theirs = paired_outcomes({name: run.episodes, DENSE: dense.episodes}, name, DENSE)
    if name == DENSE:
        return ours, PairedDifference(0.0, (0.0, 0.0), margin, "non-inferior", 0, 0, len(ours))
    return ours, paired_difference(ours, theirs, margin)


def paired_outcomes(
    episodes: Mapping[str, Sequence[EpisodeResult]], name: str, other: str
) -> tuple[list[bool], list[bool]]:
    """Return the successes of two methods, seed by seed.

    Raises:
        ValueError: if they ran on different seeds, or a seed ran twice.
    """
    ours, theirs = _by_seed(episodes[name]), _by_seed(episodes[other])
    if ours.keys() != theirs.keys():
        odd = sorted(ours.keys() ^ theirs.keys())
        raise ValueError(f"{name}: expected the seeds of {other!r}, got others: {odd[:10]} are in one only")
    return [episode.success for episode in ours.values()], [theirs[seed].success for seed in ours]


def _by_seed(episodes: Sequence[EpisodeResult]) -> dict[int, EpisodeResult]:
    by_seed = {episode.seed: episode for episode in episodes}
    if len(by_seed) != len(episodes):
        raise ValueError(f"expected one episode per seed, got {len(episodes)} for {len(by_seed)} seeds")
    return by_seed


def format_table(results: Results) -> str:
    """Return the table of a benchmark, as Markdown that also lines up in a terminal, and the lines that explain it."""
    return f"{markdown_table(results_rows(results))}\n\n{results_note(results)}"


def results_rows(results: Results) -> list[dict[str, str]]:
    """Return the rows of the table, one per method: column -> text."""
    return [_table_row(name, method) for name, method in results.methods.items()]


def _table_row(name: str, method: MethodEntry) -> dict[str, str]:
    error, baseline = method.action_error_vs_dense, name == DENSE
    tokens = {"tokens (coarse / fine)": _tokens_text(method.tokens)} if method.tokens else {}
    return {
        "method": name,
        "success": count_text(method.success),
        "vs dense, points": "" if baseline else difference_text(method.paired_vs_dense),
        "verdict": "baseline" if baseline else method.paired_vs_dense.verdict,
        "pruned": f"{100 * method.prune_rate:.1f} %",
        **tokens,
        "GFLOPs/query": f"{method.flops.per_query / 1e9:.2f}",
        "FLOPs ratio": f"{method.flops.ratio_to_dense:.3f}",
        "p50, ms": milliseconds_text(method.latency_s.p50),
        "p95, ms": milliseconds_text(method.latency_s.p95),
        "speed-up": f"{method.speedup_vs_dense:.2f}×",
        "action error (max)": "" if baseline else f"{error.mean:.2g} ({error.max:.2g})",
        "steps": f"{method.episode_length:.1f}",
    }


def _tokens_text(tokens: TokensKept) -> str:
    modes = [f"{count:.0f}" if count is not None else "-" for count in (tokens.kept_coarse, tokens.kept_fine)]
    return f"{tokens.kept_mean:.1f} ({' / '.join(modes)})"


def format_pairs(
    episodes: Mapping[str, Sequence[EpisodeResult]],
    pairs: Sequence[Sequence[str]],
    margin: float = DEFAULT_MARGIN,
) -> str:
    """Return a table of differences in success between methods of which none need be dense, paired by seed.

    Args:
        episodes: method -> its episodes.
        pairs: of names, the first against the second; at least one pair.
        margin: non-inferiority margin of the verdict on the first.

    Raises:
        ValueError: if a pair is not two of the methods, or they ran on different seeds.

    >>> once = [EpisodeResult(0, True, 8, 1, 1.0, 0.0)]
    >>> print(format_pairs({"a": once, "b": once}, [("a", "b")]))
    | method   | against   |   success |   difference, points | verdict   |
    |:---------|:----------|----------:|---------------------:|:----------|
    | a        | b         |     1 : 1 |  +0.0 [-79.3, +79.3] | undecided |
    """
    return markdown_table(pair_rows(episodes, pairs, margin))


def pair_rows(
    episodes: Mapping[str, Sequence[EpisodeResult]], pairs: Sequence[Sequence[str]], margin: float
) -> list[dict[str, str]]:
    """Return the rows of `format_pairs`: column -> text."""
    return [_pair_row(episodes, pair, margin) for pair in pairs]


def _pair_row(
    episodes: Mapping[str, Sequence[EpisodeResult]], pair: Sequence[str], margin: float
) -> dict[str, str]:
    if len(pair) != 2 or not set(pair) <= set(episodes):
        raise ValueError(f"pairs: expected two of {', '.join(episodes)}, got {list(pair)}")
    ours, theirs = paired_outcomes(episodes, *pair)
    paired = paired_difference(ours, theirs, margin)
    return {
        "method": pair[0],
        "against": pair[1],
        "success": f"{sum(ours)} : {sum(theirs)}",
        "difference, points": points_text(paired.diff, paired.ci),
        "verdict": paired.verdict,
    }


def results_note(results: Results) -> str:
    """Return the lines that explain the table."""
    machine, policy, dense = results.machine, results.policy, results.dense
    n, margin = dense.success.n, dense.paired_vs_dense.margin
    steps, flops = f"{policy.num_inference_steps} denoising steps", "denoiser only"
    if dense.tokens:
        steps, flops = f"chunks of {policy.horizon} actions", "whole network"
    lines = [
        f"{results.task}, {n} paired episodes a method (seed {results.seed}): the same initial states "
        "and the same noise for every method. Success with Wilson's 95 % interval, difference to dense with "
        "Tango's.",
        f"Verdict against a margin of {100 * margin:g} points: non-inferior if the whole interval lies above "
        f"-{100 * margin:g}, inferior if it lies below, else undecided (too few episodes to tell).",
        f"Dense: {policy.params:,} parameters, {steps}. FLOPs are "
        f"2·MAC of a query, {flops}. Latency of a query, all methods interleaved in one process, on "
        f"{machine.cpu}, {machine.device}, {threads_text(machine.threads)}, torch {machine.torch}, "
        f"{machine.date[:10]}.",
    ]
    if planning := ", ".join(_planning(results.methods)):
        lines.append(f"Planning takes, of that and measured within queries, {planning}.")
    if n < episodes_needed(margin):
        lines.append(
            f"{n} episodes cannot show non-inferiority at this margin even without one differing episode: "
            f"{episodes_needed(margin)} are needed."
        )
    return "\n".join(lines)


def _planning(methods: Mapping[str, MethodEntry]) -> Iterator[str]:
    """Yield what each planner that looks at the observation takes, and its share of a query."""
    for name, method in methods.items():
        if method.planning_s:
            seconds = method.planning_s.p50
            share = 100 * seconds / method.latency_s.p50
            yield f"{milliseconds_text(seconds)} ms ({share:.1f} %) under {name}"
