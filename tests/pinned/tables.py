"""The tables that the library makes of every committed file of results and of the committed episodes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tests.pinned import build

ASSETS = Path(__file__).parents[2] / "assets"
STORED = Path(__file__).with_name("tables.json")
_COUNTS = (200, 400)  # episodes that logs hold
_FIRST = ("results_100.json", "results_150.json")  # whose machine the tables of logs name, where there is one


def names() -> Iterator[str]:
    """The files and folders that tables are made of, relative to the assets."""
    for path in sorted(ASSETS.rglob("*")):
        if path.name == "episodes" or _maker(path) is not None:
            yield path.relative_to(ASSETS).as_posix()


def table(name: str) -> list[str]:
    """The lines of the tables that are made of one."""
    path = ASSETS / name
    return [_normalise(line) for line in "\n\n".join(_maker(path)(path)).splitlines()]


def _normalise(line: str) -> str:
    """A line of a table without what only makes its columns line up."""
    if not line.startswith("|"):
        return line
    return "|".join(
        re.sub("-+", "-", cell.strip()) if set(cell) <= set(" :-") else cell.strip()
        for cell in line.split("|")
    )


def _maker(path: Path):
    makers = {
        "lift/development/results_steps.json": _sweep,
        "results*.json": _results,
        "realtime.json": _realtime,
        "engine/engine*.json": _engine,
        "vla_latency.json": _vla_latency,
        "episodes": _episodes,
    }
    return next((maker for pattern, maker in makers.items() if path.match(pattern)), None)


def _results(path: Path) -> list[str]:
    return [build.format_table(build.load_results(path))]


def _realtime(path: Path) -> list[str]:
    return [build.format_realtime(build.load_realtime(path))]


def _engine(path: Path) -> list[str]:
    shapes = build.load_engine_results(path).shapes
    return [build.format_engine_table(name, shape) for name, shape in shapes.items()]


def _vla_latency(path: Path) -> list[str]:
    return [build.format_vla_table(build.load_vla_results(path))]


def _sweep(path: Path) -> list[str]:
    """Also the merged table and the metrics of a sweep whose trials were the dense method and another each."""
    whole = build.load_results(path)
    dense, *tested = whole.methods
    trials = [
        (
            build.Trial(name, {"method": name}, finished=True),
            replace(whole, methods={each: whole.methods[each] for each in (dense, name)}),
        )
        for name in tested
    ]
    metrics = [
        _numbers({key: number for key, number in found.items() if key.startswith("tested/")})
        for found in (build.trial_metrics(results) for _, results in trials)
    ]
    return [*_results(path), build.format_table(build.merge_trials(trials)), *metrics]


def _episodes(folder: Path) -> list[str]:
    """Tables of the logs that are long enough, numbers to more digits, and all methods against ddim10 or dense."""
    logs = {log.name.removesuffix(".jsonl.gz"): build.episodes_of(log) for log in sorted(folder.iterdir())}
    made = []
    beside = sorted(folder.parent.glob("results*.json"))
    like = max(beside, key=lambda path: path.name in _FIRST)
    for count in _COUNTS:
        episodes = {name: log[:count] for name, log in logs.items() if len(log) >= count}
        if "dense" not in episodes:
            continue
        other = "ddim10" if "ddim10" in episodes else "dense"
        results = build.results_of(episodes, like=build.load_results(like))
        made.append(build.format_table(results))
        made += [f"{name}: {_numbers(build.to_plain(method))}" for name, method in results.methods.items()]
        made.append(build.pairs_against(other, episodes, results.episode_horizon))
    return made


def _numbers(value: object) -> str:
    """JSON to nine digits: another version of a library may round the last ones otherwise."""
    return json.dumps(json.loads(json.dumps(value), parse_float=lambda text: float(f"{float(text):.9g}")))
