"""The table of a ``results.json`` and its explanation."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

from torchrl_sparse.evaluation.results.comparisons import num_comparisons, survivors
from torchrl_sparse.evaluation.results.parts import EpisodeCost, PairedEntry
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry, Results
from torchrl_sparse.evaluation.results.tables import markdown_table
from torchrl_sparse.evaluation.results.text import (
    NO_VERDICT,
    NONE_SOLVED,
    count_text,
    difference_text,
    mean_text,
    milliseconds_text,
    p_text,
    ratio_text,
    threads_text,
    verdict_text,
)
from torchrl_sparse.evaluation.rollouts.episodes import TokensKept
from torchrl_sparse.evaluation.statistics.intervals import (
    episodes_needed,
)

__all__ = [
    "comparison_rows",
    "episodes_text",
    "format_table",
    "results_note",
    "results_rows",
]


def format_table(results: Results) -> str:
    """Return a benchmark's table, as Markdown that also lines up in a terminal, and its explanation."""
    table = f"{markdown_table(results_rows(results))}\n\n{results_note(results)}"
    if not results.pairs:
        return table
    return f"{table}\n\n{markdown_table(comparison_rows(results.pairs))}"


def results_rows(results: Results) -> list[dict[str, str]]:
    """Return the table, one row per method: column -> text."""
    lasting = survivors(results)
    rows = [_table_row(name, method, lasting) for name, method in results.methods.items()]
    if results.dense_did_nothing:
        rows[1:] = [row | dict.fromkeys(_VERDICTS & row.keys(), NO_VERDICT) for row in rows[1:]]
    return rows


_VERDICTS = {"verdict", "time verdict"}


def _table_row(name: str, method: MethodEntry, lasting: set[str]) -> dict[str, str]:
    error, baseline, score = method.action_error_vs_dense, name == DENSE, method.score
    tokens = {"tokens (coarse / fine)": _tokens_text(method.tokens)} if method.tokens else {}
    executed = method.flops.executed
    return {
        "method": name,
        "success": count_text(method.success),
        **({"score": mean_text(score.mean, score.ci95)} if score else {}),
        "vs dense, points": "" if baseline else difference_text(method.judged),
        "verdict": "baseline" if baseline else verdict_text(method.judged, f"{name} success" in lasting),
        "McNemar's p": p_text(method.judged.mcnemar_p),
        **({} if score else _time_cells(name, method, lasting)),
        "pruned": f"{100 * method.prune_rate:.1f} %",
        **tokens,
        "GFLOPs/query": f"{method.flops.per_query / 1e9:.2f}",
        "FLOPs ratio": f"{method.flops.ratio_to_dense:.3f}",
        **({} if executed is None else {"executed, GFLOPs": f"{executed / 1e9:.2f}"}),
        **(_episode_cells(method.per_episode)),
        "p50, ms": milliseconds_text(method.latency_s.p50),
        "p95, ms": milliseconds_text(method.latency_s.p95),
        "speed-up": f"{method.speedup_vs_dense:.2f}×",
        "action error (max)": "" if baseline else f"{error.mean:.2g} ({error.max:.2g})",
        "steps": f"{method.episode_length:.1f}",
    }


def _time_cells(name: str, method: MethodEntry, lasting: Collection[str]) -> dict[str, str]:
    """Return the columns of times, empty for dense."""
    if name == DENSE:
        return dict.fromkeys(("time vs dense", "time verdict", "correlation"), "")
    correlation = method.correlation_with_dense
    return {
        "time vs dense": ratio_text(method.time_vs_dense),
        "time verdict": verdict_text(method.time_vs_dense, f"{name} time" in lasting),
        "correlation": "" if correlation is None else f"{correlation:.2f}",
    }


def _episode_cells(cost: EpisodeCost | None) -> dict[str, str]:
    """Return what an episode and a step cost beside dense's; nothing of a file that does not say."""
    if cost is None:
        return {}
    return {
        "an episode": f"{cost.flops_to_dense:.3f}",
        "a second": f"{cost.flops_per_step_to_dense:.3f}",
        "queries": f"{cost.queries:.1f}",
        "time, an episode": f"{cost.seconds_to_dense:.3f}",
    }


def _tokens_text(tokens: TokensKept) -> str:
    modes = [f"{count:.0f}" if count is not None else "-" for count in (tokens.kept_coarse, tokens.kept_fine)]
    return f"{tokens.kept_mean:.1f} ({' / '.join(modes)})"


def comparison_rows(pairs: Sequence[PairedEntry]) -> list[dict[str, str]]:
    """Return the rows of the table of pairs, with times where success and time are judged: column -> text."""
    return [_pair_row(pair) for pair in pairs]


def _pair_row(pair: PairedEntry) -> dict[str, str]:
    timed = {"time ratio": ratio_text(pair.time), "time verdict": verdict_text(pair.time)}
    return {
        "method": pair.method,
        "against": pair.against,
        "success": f"{pair.solved[0]} : {pair.solved[1]}",
        "difference, points": difference_text(pair.judged),
        "verdict": verdict_text(pair.judged),
        "McNemar's p": p_text(pair.judged.mcnemar_p),
        **({} if pair.score else timed),
    }


_MCNEMAR = (
    "McNemar's p is how likely a fair coin splits the episodes that one method alone solved as unevenly: exact, two-sided, of "
    "no difference at all, whatever the margin"
)
_STOPPED = ", and as of a fixed number of episodes."


def results_note(results: Results) -> str:
    """Return the explanation of the table."""
    machine, policy, dense = results.machine, results.policy, results.dense
    n, margin = _num_pairs(results), dense.paired_vs_dense.margin
    compared, scored = "difference to dense with Tango's", results.graded
    if scored:
        compared = "score, the highest reward of an episode, and its difference to dense with Student's; verdicts are on it"
    steps, flops = f"{policy.num_inference_steps} denoising steps", "planner and denoiser, as published"
    if dense.flops.executed is not None:
        flops += ", and what the engine executes of it, having folded what a policy call repeats"
    if dense.tokens:
        steps, flops = f"chunks of {policy.horizon} actions", "whole network"
    lines = [
        f"{results.task}, {episodes_text(results)}: the same initial states "
        f"and seeds of noise for every method. Success with Wilson's 95 % interval, {compared}.",
        f"Verdict against a margin of {100 * margin:g} points: non-inferior if the whole interval lies above "
        f"-{100 * margin:g}, inferior if it lies below, else inconclusive (too few episodes to tell); worse if it lies "
        "below 0, whatever the margin.",
        *(() if scored else [_MCNEMAR + (_STOPPED if results.until_conclusive else ".")]),
        *([] if scored else [_time_line(results)]),
        f"{num_comparisons(results)} comparisons with dense in this table; † marks a verdict that does not survive Holm's "
        "correction for them.",
        f"Dense: {policy.params:,} parameters, {steps}. FLOPs are "
        f"2·MAC of a policy call, {flops}. Latency of a call, all methods interleaved in one process, on "
        f"{machine.cpu}, {machine.device}, {threads_text(machine.threads)}, torch {machine.torch}, "
        f"{machine.date[:10]}.",
    ]
    if any(method.per_episode for method in results.methods.values()):
        lines.append(
            "FLOPs ratio is that of a call; beside it that of *an episode*, whose length methods change, and of *a second* of "
            "motion. Policy calls are those of an episode, *time, an episode* the seconds that all of them take, over dense's."
        )
    if planning := ", ".join(_planning(results.methods)):
        lines.append(f"Planning takes, of that and measured within policy calls, {planning}.")
    if n < episodes_needed(margin):
        lines.append(
            f"{n} episodes cannot show non-inferiority at this margin even without one differing episode: "
            f"{episodes_needed(margin)} are needed."
        )
    if results.dense_did_nothing:
        lines.append(NONE_SOLVED)
    return "\n".join(lines)


def _num_pairs(results: Results) -> int:
    """Return the episodes of the method that has the most; dense may have more."""
    counts = [method.success.n for name, method in results.methods.items() if name != DENSE]
    return max(counts, default=results.dense.success.n)


def episodes_text(results: Results) -> str:
    """Say how many episodes a method has played, and on which seeds."""
    n = _num_pairs(results)
    seeds = f"{results.split} seeds from {results.first_seed}"
    if (stopping := results.until_conclusive) is None:
        return f"{n} paired episodes a method ({seeds})"
    return (
        f"paired episodes ({seeds}) until a method's verdicts are reached, with {stopping.analyses} interim analyses up to "
        f"{stopping.max_episodes}; intervals of differences are as much wider as that takes"
    )


def _time_line(results: Results) -> str:
    margin = results.dense.time_vs_dense.margin
    return (
        f"Time vs dense is the ratio of mean steps to success, {results.episode_horizon} where there is none, with a paired "
        f"95 % interval and a verdict against a margin of {100 * margin:g} %; correlation is that of these steps with dense's "
        "over the seeds, about 0 where a method does not share dense's noise step by step."
    )


def _planning(methods: Mapping[str, MethodEntry]) -> Iterator[str]:
    """Yield what each observation-conditioned planner takes, and its share of a policy call."""
    for name, method in methods.items():
        if method.planning_s:
            seconds = method.planning_s.p50
            share = 100 * seconds / method.latency_s.p50
            yield f"{milliseconds_text(seconds)} ms ({share:.1f} %) under {name}"
