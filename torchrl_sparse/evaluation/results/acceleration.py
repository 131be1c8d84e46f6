"""``acceleration.json``: every candidate method for one policy, measured, and the chosen one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from torchrl_sparse.evaluation.latency.measure import Machine
from torchrl_sparse.evaluation.results.parts import Percentiles, Score, Success
from torchrl_sparse.evaluation.results.schema import DENSE, MethodEntry
from torchrl_sparse.evaluation.results.text import (
    NO_VERDICT,
    NONE_SOLVED,
    count_text,
    difference_text,
    mean_text,
    milliseconds_text,
    ratio_text,
    threads_text,
    verdict_text,
)
from torchrl_sparse.evaluation.statistics.differences import Difference, TimeDifference, Verdict, require
from torchrl_sparse.storage.json import read_json

__all__ = [
    "FAMILIES",
    "Acceleration",
    "Candidate",
    "Family",
    "Played",
    "acceleration_note",
    "acceleration_rows",
    "load_acceleration",
    "verdict_line",
]

Family = Literal["stochastic", "rounded", "cached", "deterministic", "pruner"]
FAMILIES: tuple[Family, ...] = get_args(Family)
_JUDGED, _TIMED = ("vs dense, points", "verdict"), ("time vs dense", "time verdict")


@dataclass(frozen=True)
class Candidate:
    """One candidate method, measured without a simulator.

    Attributes:
        family: a chain that draws noise in its steps ("stochastic") or does not ("deterministic"), the policy's own chain with
            "rounded" weights, a "cached" schedule over a chain, or a learned "pruner".
        error: mean absolute difference of executed actions to demonstrated ones, normalised.
        latency_s: of a policy call, interleaved with all others.
    """

    family: Family
    error: float
    latency_s: Percentiles

    def __post_init__(self) -> None:
        require(self.error >= 0, "error", "0 or more", self.error)


@dataclass(frozen=True)
class Played:
    """Results of one method's episodes beside dense on the same seeds; see `MethodEntry`."""

    success: Success
    paired_vs_dense: Difference
    time_vs_dense: TimeDifference
    score: Score | None = None

    @classmethod
    def of(cls, entry: MethodEntry) -> Played:
        """Build it from a benchmark's entry."""
        return cls(entry.success, entry.paired_vs_dense, entry.time_vs_dense, entry.score)

    @property
    def judged(self) -> Difference:
        """The comparison that is judged: success, or the score of a graded task."""
        return self.score.vs_dense if self.score else self.paired_vs_dense

    @property
    def did_nothing(self) -> bool:
        """Whether the method solved no episode, or scored nothing in any."""
        return not (self.score.mean if self.score else self.success.k)

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict by outcome: success and time, or the score."""
        if self.score:
            return {"the score": self.judged.verdict}
        return {"success": self.judged.verdict, "time": self.time_vs_dense.verdict}

    @property
    def is_right(self) -> bool:
        """Whether the method is non-inferior to dense in every judged outcome."""
        return {*self.verdicts.values()} == {"non-inferior"}


@dataclass(frozen=True)
class Acceleration:
    """The content of an ``acceleration.json``.

    Attributes:
        task: name of the task.
        policy: fingerprint of the policy.
        windows: of demonstrations, that errors were measured on.
        machine: of the latencies.
        candidates: method -> what was measured; the dense policy, which nothing is discarded against, among them.
        ranking: methods within the budget, the most promising first.
        chosen: the method that the saved policy runs.
        played: method -> what episodes said; empty where none were played.
        budget_ms: of the 95th percentile of a policy call's latency; None for "faster than dense".
    """

    acceleration: Literal[1]
    task: str
    policy: str
    windows: int
    machine: Machine
    candidates: dict[str, Candidate]
    ranking: list[str]
    chosen: str
    played: dict[str, Played]
    budget_ms: float | None = None

    def __post_init__(self) -> None:
        require(DENSE in self.candidates, "candidates", f"the key {DENSE!r}", sorted(self.candidates))
        for name in self.ranking:
            require(name in self.candidates, "ranking", "candidates", name)
        require(self.chosen in self.ranking, "chosen", "one of the ranking", self.chosen)
        for name in self.played:
            require(name in {DENSE, *self.ranking}, "played", "methods of the ranking", name)

    def speedup(self, name: str) -> float:
        """Return dense's median latency divided by a method's."""
        return self.candidates[DENSE].latency_s.p50 / self.candidates[name].latency_s.p50


def load_acceleration(path: str | os.PathLike) -> Acceleration:
    """Read an ``acceleration.json``.

    Raises:
        FileNotFoundError: if there is none.
        InputError: naming file and key, if it is of another kind or does not agree with itself.
    """
    return read_json(path, Acceleration)


def acceleration_rows(acceleration: Acceleration) -> list[dict[str, str]]:
    """Return the rows of the table: the dense policy, the ranked candidates, and those over the budget."""
    ranking = acceleration.ranking
    over = [name for name in acceleration.candidates if name not in {DENSE, *ranking}]
    over.sort(key=lambda name: acceleration.candidates[name].latency_s.p95)
    return [_row(acceleration, name) for name in [DENSE, *ranking, *over]]


def acceleration_note(acceleration: Acceleration) -> str:
    """Return the explanation of the table."""
    machine, budget = acceleration.machine, acceleration.budget_ms
    allowed, first = (
        "faster than dense",
        "the fastest that is no farther from demonstrations than dense, else the nearest",
    )
    if budget is not None:
        allowed, first = f"within {budget:g} ms in 95 % of the policy calls", "the one of least error"
    return (
        f"{verdict_line(acceleration)} {acceleration.task}: {len(acceleration.candidates) - 1} candidates, of which "
        f"{len(acceleration.ranking)} are {allowed}, in the order in which they would be played: of every family in turn "
        f"{first}. Error: of executed actions to those of {acceleration.windows} windows of demonstrations, normalised; "
        "it agrees with success in part alone, so episodes have the last word. Latency of a policy call, all candidates "
        f"interleaved in one process, on {machine.cpu}, {threads_text(machine.threads)}, PyTorch {machine.torch}, "
        f"{machine.date}."
    )


def verdict_line(acceleration: Acceleration) -> str:
    """Return one or two sentences on the chosen method and the evidence for it."""
    name, played = acceleration.chosen, acceleration.played
    latency = acceleration.candidates[name].latency_s
    chosen = (
        f"{name}: {milliseconds_text(latency.p50)} ms a policy call (95th percentile {milliseconds_text(latency.p95)} ms), "
        f"{acceleration.speedup(name):.1f} times as fast as dense."
    )
    if name not in played:
        return f"{chosen} Chosen offline, by the error to demonstrations alone: no episode was played."
    ours, dense = played[name], played[DENSE]
    told = f"It solved {count_text(ours.success)}, dense {count_text(dense.success)}"
    if ours.score and dense.score:
        told = f"Its score is {_score_text(ours.score)}, dense's {_score_text(dense.score)}"
    if dense.did_nothing:
        return f"{chosen} {NONE_SOLVED}"
    if ours.is_right:
        return f"{chosen} {told}: non-inferior to dense in {' and in '.join(ours.verdicts)}."
    found = ", ".join(f"{verdict} in {what}" for what, verdict in ours.verdicts.items())
    return (
        f"{chosen} {told}: {found}. No method played is shown to be as good as dense; this one comes nearest."
    )


def _score_text(score: Score) -> str:
    return mean_text(score.mean, score.ci95)


def _row(acceleration: Acceleration, name: str) -> dict[str, str]:
    candidate, played = acceleration.candidates[name], acceleration.played.get(name)
    return {
        "method": f"{name} (chosen)" if name == acceleration.chosen else name,
        "family": "baseline" if name == DENSE else candidate.family,
        "error": f"{candidate.error:.4f}",
        "p50, ms": milliseconds_text(candidate.latency_s.p50),
        "p95, ms": milliseconds_text(candidate.latency_s.p95),
        "speed-up": f"{acceleration.speedup(name):.2f}×",
        "budget": "" if name == DENSE else "within" if name in acceleration.ranking else "over",
        **(_episode_cells(name, played, acceleration.played[DENSE]) if acceleration.played else {}),
    }


def _episode_cells(name: str, played: Played | None, dense: Played) -> Mapping[str, str]:
    """Return what episodes said: success and time, or the score where dense has one; empty of a method not played."""
    columns = ("score", *_JUDGED) if dense.score else ("success", *_JUDGED, *_TIMED)
    if played is None:
        return dict.fromkeys(columns, "")
    told = count_text(played.success) if dense.score is None else _score_text(played.score)
    if name == DENSE:
        return dict.fromkeys(columns, "") | {columns[0]: told}
    judged, time = played.judged, played.time_vs_dense
    verdicts = verdict_text(judged), verdict_text(time)
    if dense.did_nothing:
        verdicts = NO_VERDICT, NO_VERDICT
    texts = (told, difference_text(judged), verdicts[0], ratio_text(time), verdicts[1])
    return dict(zip(columns, texts, strict=False))
