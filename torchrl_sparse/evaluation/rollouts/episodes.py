"""Results of evaluated episodes, their totals, and a log that survives a killed evaluation."""

import gzip
import json
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import IO, Any, Literal

from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.disk import naming_full_disk
from torchrl_sparse.storage.atomic import atomic_path
from torchrl_sparse.storage.json import MAX_BYTES, describe_differences, parse_json

__all__ = [
    "EpisodeLog",
    "EpisodeResult",
    "TokensKept",
    "Totals",
    "read_episodes",
    "read_identity",
    "tokens_kept",
    "totals",
]


@dataclass(frozen=True)
class EpisodeResult:
    """One finished episode.

    Attributes:
        seed: the episode's seed; it fixes the initial state and, with the step, all noise of every policy call.
        success: whether the task's predicate held at any step.
        length: environment steps.
        queries: calls of the policy.
        flops_total: FLOPs (2 * MAC) of all calls together, as `torchrl_sparse.keys.FLOPS` counts them.
        prune_rate: pruned share of the blocks, or of the visual tokens, mean over all calls, in [0, 1].
        latency: seconds of each call as the policy reported it. A batched call reports its duration for
            every row, so these describe the rollout; the figures of a table come from
            :func:`measure_latency`.
        kept: visual tokens in a decoder layer, mean over the layers, of each call; empty for a policy without them.
        fine: whether each call was made in the controller's fine mode; empty without a controller.
        score: highest reward of a step. Published results on Push-T are means of it.
        completed: parts of the task that were done, None for a task that counts none.
        way: which of its ways the task was done, None for a task that does not tell; -1 if none showed, -2 if
            it failed by going between them.
    """

    seed: int
    success: bool
    length: int
    queries: int
    flops_total: float
    prune_rate: float
    latency: tuple[float, ...] = ()
    kept: tuple[float, ...] = ()
    fine: tuple[bool, ...] = ()
    score: float | None = None
    completed: int | None = None
    way: int | None = None


@dataclass(frozen=True)
class Totals:
    """Mean costs of several episodes: per policy call or per episode, whichever applies.

    Attributes:
        flops_per_query: FLOPs (2 * MAC).
        prune_rate: mean over calls, in [0, 1].
        episode_length: mean environment steps.
        queries: number of calls.
    """

    flops_per_query: float
    prune_rate: float
    episode_length: float
    queries: int


@dataclass(frozen=True)
class TokensKept:
    """Visual tokens in a decoder layer, mean over layers and policy calls: all calls, those in fine mode, and the others.

    The last two are None where there was no such call, as without a controller.
    """

    kept_mean: float
    kept_fine: float | None
    kept_coarse: float | None


def totals(episodes: Sequence[EpisodeResult]) -> Totals:
    """Average the costs of episodes, weighting every policy call equally.

    Raises:
        InputError: if there are no episodes or no call.

    >>> totals([EpisodeResult(0, True, 8, 1, 10.0, 0.5), EpisodeResult(1, True, 24, 3, 90.0, 0.9)])
    Totals(flops_per_query=25.0, prune_rate=0.8, episode_length=16.0, queries=4)
    """
    queries = sum(episode.queries for episode in episodes)
    if queries == 0:
        raise InputError(
            f"episodes: expected at least one call of the policy, got none in {len(episodes)} episodes"
        )
    return Totals(
        flops_per_query=sum(episode.flops_total for episode in episodes) / queries,
        prune_rate=sum(episode.prune_rate * episode.queries for episode in episodes) / queries,
        episode_length=sum(episode.length for episode in episodes) / len(episodes),
        queries=queries,
    )


def tokens_kept(episodes: Sequence[EpisodeResult]) -> TokensKept | None:
    """Average the visual tokens of episodes, weighting every policy call equally; None for a policy without visual tokens.

    >>> tokens_kept([EpisodeResult(0, True, 8, 2, 10.0, 0.5, kept=(90.0, 30.0), fine=(True, False))])
    TokensKept(kept_mean=60.0, kept_fine=90.0, kept_coarse=30.0)
    """
    kept = [count for episode in episodes for count in episode.kept]
    if not kept:
        return None
    modes = [
        pair for episode in episodes if episode.fine for pair in zip(episode.fine, episode.kept, strict=True)
    ]
    fine, coarse = ([count for mode, count in modes if mode is wanted] for wanted in (True, False))
    return TokensKept(_mean(kept), _mean(fine) if fine else None, _mean(coarse) if coarse else None)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


@dataclass(frozen=True)
class _Header:
    episode_log: Literal[1]
    identity: dict[str, Any]


class EpisodeLog:
    """Append-only JSON-lines file of :class:`EpisodeResult`, one per seed, safe against a kill at any moment.

    The first line names what was evaluated. Every episode is one line, without what is at its default, flushed to the disk
    before :meth:`append` returns.
    A last line without its newline was torn by a kill: it is cut off on opening, and its seed runs again. A log that lies there
    compressed alone, as ``PATH.gz``, is unpacked and gone on with.

    Args:
        path: the file; it and its folder are made if missing.
        identity: what the episodes belong to (method, task, policy fingerprint, ...), JSON values.
            Reopening a log under another identity is refused, so that a resume never mixes two methods, unless it holds no
            episode, as after a run that failed at once.

    Raises:
        InputError: if the file is not such a log, has a damaged line before its last, or has another
            identity.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "dense.jsonl"
    >>> EpisodeLog(path, {"method": "dense"}).append(EpisodeResult(7, True, 30, 4, 6.3e10, 0.0))
    >>> EpisodeLog(path, {"method": "dense"}).episodes[7].length
    30
    """

    def __init__(self, path: str | os.PathLike, identity: Mapping[str, Any] | None = None) -> None:
        self.path = Path(path)
        self.identity = dict(identity or {})
        self.episodes: dict[int, EpisodeResult] = {}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        header = asdict(_Header(1, self.identity))
        stored = _log_path(self.path)
        content = _content(stored)
        if _line(header).encode().startswith(content):
            # A new log, or one killed while its header was written.
            self.path.write_bytes(b"")
            self._write(header)
            return
        # What follows the last newline is torn; it is cut off only once the header has shown whose file this is.
        whole = content[: content.rfind(b"\n") + 1] or content
        first, *lines = whole.splitlines()
        found = parse_json(first, _Header, f"{self.path}:1")
        if not lines:
            self.path.write_bytes(b"")
            self._write(header)
            return
        self._check_identity(found)
        for number, line in enumerate(lines, start=2):
            episode = parse_json(line, EpisodeResult, f"{self.path}:{number}")
            self.episodes.setdefault(episode.seed, episode)
        if stored != self.path:
            with atomic_path(self.path) as temporary:
                temporary.write_bytes(whole)
        else:
            os.truncate(self.path, len(whole))

    def append(self, episode: EpisodeResult) -> None:
        """Append one episode and flush it to disk.

        Raises:
            InputError: if its seed is already in the log.
        """
        if episode.seed in self.episodes:
            raise InputError(f"{self.path}: seed {episode.seed} is already in the log")
        self._write(_told(episode))
        self.episodes[episode.seed] = episode

    def missing(self, seeds: Iterable[int]) -> list[int]:
        """Return the seeds without an episode, in order."""
        return [seed for seed in seeds if seed not in self.episodes]

    def _write(self, data: Mapping[str, Any]) -> None:
        with naming_full_disk(self.path), open(self.path, "a", encoding="utf-8") as file:
            file.write(_line(data))
            file.flush()
            os.fsync(file.fileno())

    def _check_identity(self, header: _Header) -> None:
        # Compared as JSON, so that tuples and lists, which the file cannot tell apart, are equal.
        if differing := describe_differences(header.identity, json.loads(json.dumps(self.identity))):
            raise InputError(
                f"{self.path}: holds other episodes: {differing}; choose another out or move it away"
            )


def _line(data: Mapping[str, Any]) -> str:
    return json.dumps(data, allow_nan=False, separators=(",", ":")) + "\n"


def _told(episode: EpisodeResult) -> dict[str, Any]:
    """Return what of an episode is not its default: most know neither tokens nor parts nor ways."""
    values = ((field, getattr(episode, field.name)) for field in fields(episode))
    return {field.name: value for field, value in values if value != field.default}


def read_episodes(path: str | os.PathLike) -> Iterator[EpisodeResult]:
    """Yield the episodes of a log without changing it; reads ``PATH.gz`` if there is no ``PATH``.

    Raises:
        FileNotFoundError: if there is neither.
        InputError: naming file and line, if one is damaged.
    """
    path = _log_path(path)
    lines = _lines(path)
    next(lines, None)
    for number, line in enumerate(lines, start=2):
        yield parse_json(line, EpisodeResult, f"{path}:{number}")


def read_identity(path: str | os.PathLike) -> dict[str, Any]:
    """Return the identity that a log's episodes share, see `EpisodeLog`; errors are those of `read_episodes`."""
    path = _log_path(path)
    return parse_json(next(_lines(path), b""), _Header, f"{path}:1").identity


def _log_path(path: str | os.PathLike) -> Path:
    """Return where a log is: there, or compressed beside it."""
    path = Path(path)
    packed = path.with_name(f"{path.name}.gz")
    return packed if packed.is_file() and not path.exists() else path


def _content(path: Path) -> bytes:
    """Return what a log holds, nothing if there is none; of a compressed one no more than a file may hold."""
    if path.suffix != ".gz":
        return path.read_bytes() if path.exists() else b""
    with _opened(path) as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: expected at most {MAX_BYTES} bytes unpacked, got more")
    return content


def _lines(path: Path) -> Iterator[bytes]:
    if not path.is_file():
        raise FileNotFoundError(f"expected a log of episodes {path}, got none")
    with _opened(path) as file:
        while line := file.readline(MAX_BYTES + 1):
            yield line


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        try:
            yield file
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise InputError(
                f"{path}: expected a whole compressed log, got one that is damaged: {error}"
            ) from error
