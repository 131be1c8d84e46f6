"""Writer of demonstrations in robomimic's HDF5 layout, one episode at a time, safe against kills.

============================  =====================  =========================================================
in the file                   shape, type            meaning
============================  =====================  =========================================================
``data`` attributes           ``env_args`` json,     how the environment was made; number of samples of all
                              ``total`` int          demonstrations; ``collection`` json, how they were made
``data/demo_<i>`` attributes  int, str, bool         ``num_samples``, ``model_file`` (MuJoCo xml), ``seed``,
                                                     ``operator``, ``success``; ``ep_meta`` json, its ``lang`` is
                                                     the instruction (the convention of RoboCasa's files);
                                                     ``driven`` int, first steps that a policy drove; absent for none
``states``                    f64 [T, S]             simulator state before each action; the first restores
                                                     the episode's start
``actions``                   f64 [T, 7 * arms]      the expert's clean absolute command: position, m;
                                                     rotation vector, rad; gripper, -1 open to 1 closed
``executed_actions``          f64 [T, 7 * arms]      what was executed: the same with the injected disturbance, or what
                                                     the policy commanded
``rewards``, ``dones``        f64, i64 [T]           1 where the task succeeded
``obs/<key>``                 f64 [T, n]             observations before each action: the task's state and, of robosuite's
                                                     tasks, ``robot<i>_eef_quat``, which published policies observe
============================  =====================  =========================================================
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_sparse.data.hdf5_files import new_hdf5
from torchrl_sparse.data.hdf5_reader import demo_group, open_demos


@dataclass(frozen=True)
class Episode:
    """One finished episode; the arrays are those of the table above, ``observations`` by key.

    Benchmarks outside robosuite have no ``model_file`` and no ``instruction``, their ``states`` are what they observe, and
    their actions are those of the environment; the seed restores an episode's start.
    """

    seed: int
    operator: str
    instruction: str | None
    success: bool
    model_file: str
    states: np.ndarray
    actions: np.ndarray
    executed_actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    observations: Mapping[str, np.ndarray]
    driven: int = 0

    def __len__(self) -> int:
        return len(self.actions)


def write_episode(path: Path, episode: Episode) -> None:
    """Write one episode to a file of its own. A kill leaves either the whole file or none."""
    with new_hdf5(path) as file:
        _fill(file.create_group("demo"), episode)


@dataclass(frozen=True)
class Outcome:
    """Result of an episode: its steps, its success, and how many of its first steps a policy drove."""

    length: int
    success: bool
    driven: int


def episode_outcome(path: Path) -> Outcome:
    """Return the outcome of an episode written by `write_episode`."""
    with open_demos(path) as file:
        demo = file.group("demo")
        return Outcome(demo.count("num_samples"), demo.flag("success"), demo.count("driven", default=0))


def merge_episodes(
    path: Path, parts: Iterable[Path], *, env_args: Mapping[str, Any], collection: Mapping[str, Any]
) -> None:
    """Join episode files into one demonstration file, ``demo_0`` onwards in the order given.

    Equal episodes give equal bytes. A kill leaves either the whole file or none.
    """
    named = {f"demo_{index}": part for index, part in enumerate(parts)}
    total = sum(episode_outcome(part).length for part in named.values())
    attributes = {"total": total, "env_args": env_args, "collection": collection}
    with new_hdf5(path) as file:
        data = lay_out(file, named, attributes)
        for name, part in named.items():
            with open_demos(part) as source:
                demo = source.group("demo")
                demo.copy_attributes(data[name])
                for child in demo.names():
                    demo.copy(data[name], child)


def split_episodes(path: Path, part: Callable[[int], Path]) -> None:
    """Undo `merge_episodes`: write each demonstration to the file ``part(seed)``, unless it exists."""
    with open_demos(path) as source:
        for name in (data := demo_group(source)).names():
            demo = data.group(name)
            if not (episode := part(demo.count("seed"))).exists():
                with new_hdf5(episode) as file:
                    demo.copy_to(file, "demo")


def lay_out(file: h5py.File, names: Iterable[str], attributes: Mapping[str, Any]) -> h5py.Group:
    """Create the group ``data`` with its attributes, mappings as JSON, and an empty group for each demonstration.

    Made before anything is filled in, the index of demonstrations lies at the front of the file, so that one which is cut
    off later still tells which demonstration broke.
    """
    data = file.create_group("data")
    for name, value in attributes.items():
        data.attrs[name] = json.dumps(value, sort_keys=True) if isinstance(value, Mapping) else value
    for name in names:
        data.create_group(name)
    return data


def _fill(group: h5py.Group, episode: Episode) -> None:
    group.attrs["num_samples"] = len(episode)
    group.attrs["model_file"] = episode.model_file
    group.attrs["seed"] = episode.seed
    group.attrs["operator"] = episode.operator
    group.attrs["ep_meta"] = json.dumps({"lang": episode.instruction})
    group.attrs["success"] = episode.success
    if episode.driven:
        group.attrs["driven"] = episode.driven
    for name in ("states", "actions", "executed_actions", "rewards", "dones"):
        group[name] = getattr(episode, name)
    for key, value in episode.observations.items():
        group[f"obs/{key}"] = value
