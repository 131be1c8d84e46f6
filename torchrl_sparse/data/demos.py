"""Collection of scripted demonstrations: run experts, keep the successes, survive being killed.

The demonstrations are scripted, never human. Episode ``i`` is fixed by ``seed + i`` alone, so a file can be
made again, and continued after a kill, to the same bytes on the same machine. A policy may drive first, see
`torchrl_sparse.data.dagger`.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path

from torchrl.envs import EnvBase

from torchrl_sparse.data.dagger import Driver, Driving, load_driver
from torchrl_sparse.data.demo_workers import in_order
from torchrl_sparse.data.demonstrate import demonstrate
from torchrl_sparse.data.hdf5_nodes import Node
from torchrl_sparse.data.hdf5_reader import ArrayReader, demo_group, open_demo, open_demos
from torchrl_sparse.data.hdf5_writer import episode_outcome, merge_episodes, split_episodes, write_episode
from torchrl_sparse.data.instructions import read_instruction
from torchrl_sparse.data.parts import check_same, claim_parts, parts_of
from torchrl_sparse.envs.robosuite import InitialState
from torchrl_sparse.envs.seeds import tuning_seeds
from torchrl_sparse.envs.tasks import find_task
from torchrl_sparse.errors import InputError
from torchrl_sparse.runtime.backends import check_backend
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.storage.json import parse_json


@dataclass(frozen=True)
class Collection:
    """Settings of a collection.

    Attributes:
        task: name or alias of a task that has an expert.
        episodes: demonstrations to keep; with ``keep_failures``, episodes to attempt.
        quality: "proficient", "recovering" or "mixed", see `torchrl_sparse.envs.experts.operators`.
        seed: the first episode's; the others follow in order.
        keep_failures: keep failed episodes too, and those that the policy solved alone.
        driving: the policy that drives first, of an episode that the expert finishes; None for the expert alone.

    Raises:
        InputError: if a value is out of its range, a seed is one of tests, or the task has no expert or not of that quality.
    """

    task: str
    episodes: int
    quality: str = "proficient"
    seed: int = 0
    keep_failures: bool = False
    driving: Driving | None = None

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise InputError(f"episodes: expected at least 1, got {self.episodes}")
        if self.seed < 0:
            raise InputError(f"seed: expected 0 or more, got {self.seed}")
        tuning_seeds(self.seed, self.episodes)  # what is trained on them is not tested on them
        task = find_task(self.task)
        task.load_expert()
        if self.quality not in (known := task.demonstrator.qualities):
            raise InputError(
                f"quality: expected one of {', '.join(known)} for {task.name}, got {self.quality!r}"
            )


@dataclass(frozen=True)
class Summary:
    """Tally of a collection.

    Attributes:
        attempts: episodes.
        successes: those of them that succeeded.
        kept: episodes in the file.
        mean_length: steps of those.
        alone: successes of the policy that drove, before the expert took over: they teach nothing.
    """

    attempts: int
    successes: int
    kept: int
    mean_length: float
    alone: int = 0

    def __str__(self) -> str:
        alone = f" ({self.alone} by the policy alone)" if self.alone else ""
        return (
            f"successes/attempts {self.successes}/{self.attempts}{alone}, kept {self.kept}, "
            f"mean length {self.mean_length:.1f} steps"
        )


@dataclass(frozen=True, kw_only=True)
class _Finished(Collection):
    """The attribute ``collection`` of a file."""

    summary: Summary


def collect(
    path: str | Path,
    collection: Collection,
    *,
    env: EnvBase | None = None,
    workers: int = 1,
    backend: str = "process",
    on_episode: Callable[[Summary], None] | None = None,
) -> Summary:
    """Collect demonstrations into ``path``, resuming an interrupted run.

    Every finished episode is first committed to ``<path>.parts``; the file itself appears, complete, at the
    end. Calling again after that only reports or, for more episodes, goes on from those of the file.

    Args:
        path: the HDF5 file to make; layout in `torchrl_sparse.data.hdf5_writer`.
        collection: what to collect.
        env: an environment of that task to use; made when it is needed by default. Workers make their own.
        workers: how many make episodes at a time; the file is the same whatever their number. One that dies is reported as
            a warning and its episode made again.
        backend: "process" or "ray", see `backend_runtime`. Machines of a Ray cluster must share the folder of ``path``.
        on_episode: called with the tally so far, after episodes found on disk and after each new one.

    Raises:
        InputError: if ``path`` or its parts were collected with other settings, an option is out of range, or the policy that
            is to drive cannot, see `load_driver`.
    """
    path = Path(path)
    check_backend(backend, workers)
    _load_driver(collection)  # before anything is written
    settings = asdict(collection)
    extendable = {name: value for name, value in settings.items() if name != "episodes"}
    shorter = False
    if path.exists():
        made = _read_finished(path)
        shorter = made.episodes < collection.episodes
        check_same(path, asdict(made), extendable if shorter else settings)
        if not shorter:
            shutil.rmtree(parts_of(path), ignore_errors=True)  # a kill between the two last steps leaves them
            return made.summary
    parts = claim_parts(path, extendable).absolute()  # workers may run in another folder
    if shorter:
        split_episodes(path, partial(_part, parts))
    kept: list[Path] = []
    tally = Summary(0, 0, 0, 0.0)
    with closing(_seeds_made(parts, collection, env, workers, backend)) as seeds:
        while tally.kept < collection.episodes:
            tally = _add(tally, _part(parts, next(seeds)), kept, collection.keep_failures)
            if on_episode is not None:
                on_episode(tally)
            if not collection.keep_failures:
                _check_yield(tally)
    task = find_task(collection.task)
    made_in = task.demonstrator.env_args(task)
    merge_episodes(path, kept, env_args=made_in, collection=settings | {"summary": asdict(tally)})
    shutil.rmtree(parts)
    return tally


def _seeds_made(
    parts: Path, collection: Collection, env: EnvBase | None, workers: int, backend: str
) -> Generator[int, None, None]:
    """Make one episode after the other, and yield its seed."""
    if workers == 1 and backend == "process":
        own = cache(lambda: find_task(collection.task).make() if env is None else env)
        return (_make_part(parts, collection, own, seed) for seed in itertools.count(collection.seed))
    make = partial(_make_part, parts, collection, partial(_worker_env, collection.task))
    return in_order(make, collection.seed, workers, backend=backend)


def _part(parts: Path, seed: int) -> Path:
    return parts / f"{seed:010d}.h5"


def _make_part(parts: Path, collection: Collection, environment: Callable[[], EnvBase], seed: int) -> int:
    """Make the episode of a seed, unless it is there; return the seed."""
    if not _part(parts, seed).exists():
        task, driver = find_task(collection.task), _load_driver(collection)
        write_episode(_part(parts, seed), demonstrate(task, environment(), seed, collection.quality, driver))
    return seed


def _load_driver(collection: Collection) -> Driver | None:
    return load_driver(collection.task, collection.driving) if collection.driving is not None else None


@cache
def _worker_env(task: str) -> EnvBase:
    """Make the environment of a worker process once: it takes longer than an episode."""
    return find_task(task).make()


def read_initial_state(path: str | Path, index: int) -> InitialState:
    """Read the initial state of one demonstration, for ``env.reset(initial_state=...)``.

    Its seed is -1 where the file names none, as those of people do not.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: naming file and demonstration, if there is none of that number, it is damaged, or its model is of robosuite
            1.4 or earlier, which robosuite 1.5 cannot play.
    """
    with open_demos(path) as file:
        demo, length = open_demo(demo_group(file), f"demo_{index}")
        return InitialState(
            model_xml=_read_model(demo),
            sim_state=ArrayReader(file).numbers(demo, "states", length)[0],
            seed=demo.count("seed", default=-1),
            instruction=read_instruction(demo),
        )


def _read_model(demo: Node) -> str:
    """Read the MuJoCo model of a demonstration; "" where it is of another simulator."""
    if (model := demo.text("model_file")) is None:
        raise InputError(f"{demo.where}: expected an attribute model_file, the episode's model, got none")
    if (
        "gripper0_" in model and "gripper0_right_" not in model
    ):  # 1.5 calls the gripper's parts by the side of its arm
        raise InputError(
            f"{demo.where}, model_file: expected a model of robosuite 1.5, got one of robosuite 1.4 or earlier, "
            "whose parts have other names"
        )
    return model


def _check_yield(tally: Summary) -> None:
    if tally.attempts >= 20 and tally.kept * 20 < tally.attempts:
        whose = "the expert fails" if tally.alone * 2 < tally.attempts else "the policy needs no expert"
        raise RunFailed(f"{whose}: {tally}; keep_failures=true collects such episodes")


def _read_finished(path: Path) -> _Finished:
    with open_demos(path) as file:
        return parse_json(demo_group(file).text("collection") or "{}", _Finished, f"{path}: collection")


def _add(tally: Summary, part: Path, kept: list[Path], keep_failures: bool) -> Summary:
    made = episode_outcome(part)
    alone = made.success and made.driven == made.length
    total = tally.mean_length * tally.kept
    if keep_failures or (made.success and not alone):
        kept.append(part)
        total += made.length
    counts = tally.attempts + 1, tally.successes + made.success, len(kept)
    return Summary(*counts, total / max(len(kept), 1), tally.alone + alone)
