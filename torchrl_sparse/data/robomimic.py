"""Demonstrations in robomimic's HDF5 layout (arXiv:2108.03298), cut into training windows.

Layout: ``data/demo_<i>/actions`` [T, 7 * arms] absolute poses (position, rotation vector, gripper),
``data/demo_<i>/obs/<key>`` [T, n], images u8 [T, h, w, 3] among them, and the attribute ``num_samples`` = T on every
demonstration. The attribute ``env_args`` of ``data`` says of which task and controller they are, see
`torchrl_sparse.data.controller_settings`; observations and arrays that nobody asks for are not read. Published files record
deltas and need `torchrl_sparse.data.absolute.convert_demos` first. Quaternions of the grip site have the sign that
environments show. Writing is in `torchrl_sparse.data.hdf5_writer`. Images are streamed: one demonstration at a time is in
memory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.data.hdf5_reader import (
    ArrayReader,
    demo_group,
    demo_names,
    each_path,
    open_demos,
)
from torchrl_sparse.data.images import RecordedImages, read_images
from torchrl_sparse.data.recorded_control import check_recorded_task, read_control
from torchrl_sparse.data.recorded_episode import read_episode
from torchrl_sparse.envs.contract import Contract
from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.convention import Convention

__all__ = ["Demonstrations", "join_demos", "read_demos"]


@dataclass(frozen=True)
class Demonstrations:
    """Demonstration episodes, concatenated along time.

    Attributes:
        data: [N] with ``("observation", "state")`` f32 [N, Ds], images ``("observation", name)`` u8 [N, 3, h, w] if
            they were asked for, and ``"action"`` f32 [N, 10 * arms], the action taken in that state. It can be
            memory-mapped: ``data.memmap(folder)``.
        starts: i64 [E + 1]; episode e is rows ``starts[e]`` up to, not including, ``starts[e + 1]``.
        driven: i64 [E]; so many first rows of an episode a policy drove before the expert took over, see
            `torchrl_sparse.data.dagger`. They are history of the windows that follow. No row by default.
        contract: what the observations mean; None if nobody noted it.
    """

    data: TensorDict
    starts: Tensor
    driven: Tensor = field(default=None)  # never None once made
    contract: Contract | None = None

    def __post_init__(self) -> None:
        if self.driven is None:
            object.__setattr__(self, "driven", torch.zeros(len(self), dtype=torch.int64))

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.starts) - 1

    def episode(self, index: int) -> TensorDict:
        """Return the rows of one episode."""
        return self.data[int(self.starts[index]) : int(self.starts[index + 1])]

    def between(self, first: int, last: int) -> Demonstrations:
        """Return the episodes from ``first`` to before ``last``."""
        starts = self.starts[first : last + 1]
        return replace(
            self,
            data=self.data[int(starts[0]) : int(starts[-1])],
            starts=starts - starts[0],
            driven=self.driven[first:last],
        )

    def window_rows(
        self, horizon: int, n_obs_steps: int, n_action_steps: int, episodes: Sequence[int] | None = None
    ) -> Tensor:
        """Return the rows of all training windows, i64 [W, horizon], cut as in Diffusion Policy's sampler.

        A window may begin up to ``n_obs_steps - 1`` rows before its episode and end up to
        ``n_action_steps - 1`` after it; rows outside repeat the first or last one. None crosses episodes. The present row,
        the last of the observations, is the first that the expert drove or later; rows before it have the expert's labels too.

        Args:
            horizon: rows of a window; the first ``n_obs_steps`` are also its observations.
            n_obs_steps: observations of a policy call.
            n_action_steps: actions executed of a call.
            episodes: episodes to cut; all by default.

        Raises:
            InputError: if a size is below 1, or ``n_obs_steps - 1 + n_action_steps`` exceeds ``horizon``, or
                no window fits.
        """
        _check_window(horizon, n_obs_steps, n_action_steps)
        windows = []
        for index in range(len(self)) if episodes is None else episodes:
            first, last = int(self.starts[index]), int(self.starts[index + 1]) - 1
            earliest = first + int(self.driven[index]) - (n_obs_steps - 1)
            end = last + 1 - horizon + n_action_steps
            begin = torch.arange(earliest, max(earliest, end))
            windows.append((begin[:, None] + torch.arange(horizon)).clamp(first, last))
        rows = torch.cat(windows) if windows else torch.empty(0, horizon, dtype=torch.int64)
        if not len(rows):
            raise InputError(
                f"horizon: expected one that fits in one of {len(windows)} episodes, got {horizon}"
            )
        return rows

    def windows(self, rows: Tensor, n_obs_steps: int) -> TensorDict:
        """Return training samples [B] for the windows ``rows`` i64 [B, H].

        Returns:
            ``("history", name)`` [B, To, ...] of each observation, and ``"action"`` [B, H, A]; action ``To - 1``
            belongs to the last observation.
        """
        observed = rows[:, :n_obs_steps]
        windows = {
            keys.history(name): value[observed] for name, value in self.data.get("observation").items()
        }
        return TensorDict(windows | {keys.ACTION: self.data.get(keys.ACTION)[rows]}, batch_size=[len(rows)])


def read_demos(
    paths: str | Path | Sequence[str | Path],
    state_keys: Sequence[str],
    *,
    filter_key: str | None = None,
    cameras: Mapping[str, str] | None = None,
    image_folder: str | Path | None = None,
    poses: bool = True,
    task: str | None = None,
    convention: Convention = "1.5",
) -> Demonstrations:
    """Read all demonstrations of one robomimic file, in numerical order, or of several, see `join_demos`.

    Args:
        paths: of an HDF5 file, or of several, such as those of DAgger's rounds.
        state_keys: observations that make up the state, concatenated in this order.
        filter_key: only those that a file lists as ``mask/<filter_key>``, e.g. "train" or "better".
        cameras: images to read: the name here -> the observation there, e.g. ``{"image": "agentview_image"}``.
        image_folder: where to put the images as memory-mapped files, for more of them than there is memory; in
            memory by default.
        poses: actions are absolute poses of arms, as the file's controller says and the recorded hands bear out; False takes
            them as they are, as benchmarks outside robosuite want it.
        task: name of the task that they are to show; None for any known one.
        convention: the version of robosuite whose meaning ``object`` shall have, whichever recorded it.

    Returns:
        f32 demonstrations; poses are converted from rotation vectors to 6-D rotations.

    Raises:
        FileNotFoundError: if there is no file.
        InputError: if a file is truncated or malformed, does not say what it is of, its actions are deltas or were played by
            another controller, robot or at another rate, it is of another task, there is no such filter key, or its objects
            cannot be had in that convention; the message names file, demonstration and dataset. As `join_demos` if files
            differ.

    Examples:
        >>> demos = read_demos("data/lift.h5", find_robosuite_task("Lift").state_keys)  # doctest: +SKIP
        >>> demos.data["action"].shape[1], len(demos)  # doctest: +SKIP
        (10, 200)
    """
    if not state_keys:
        raise InputError("state_keys: expected at least one observation key, got none")
    files, parts = [], []
    for path in each_path(paths):
        wanted = Contract(task, tuple(state_keys), convention, dict(cameras or {}))
        names, part = _read_numbers(path, wanted, filter_key, poses)
        files.append(RecordedImages(path, dict(zip(names, part.starts.diff().tolist(), strict=True))))
        parts.append(part)
    demos = join_demos(parts)
    for name, key in (cameras or {}).items():
        demos.data["observation", name] = read_images(files, key, image_folder)
    return demos


def _read_numbers(
    path: str | Path, wanted: Contract, filter_key: str | None, poses: bool
) -> tuple[list[str], Demonstrations]:
    """Return the names of a file's demonstrations, and these without images."""
    with open_demos(path) as file:
        names = demo_names(file, filter_key)
        task = check_recorded_task(file, wanted.task, poses=poses)
        control = read_control(file) if poses else None
        if control is not None and control.are_deltas:
            raise InputError(
                f"{path}: expected absolute poses, got deltas, as its controller says; "
                "recipes/convert_demos.py converts them"
            )
        data, reader = demo_group(file), ArrayReader(file)
        episodes = [read_episode(reader, data, name, wanted, control) for name in names]
    widths = sorted({(state.shape[1], action.shape[1]) for state, action, _ in episodes})
    if len(widths) > 1:
        raise InputError(f"{path}: expected one size of state and action in all demonstrations, got {widths}")
    states, actions, driven = zip(*episodes, strict=True)
    starts = torch.tensor([0, *map(len, actions)]).cumsum(0)
    state, action = (torch.from_numpy(np.concatenate(part)) for part in (states, actions))
    data = TensorDict({keys.STATE: state, keys.ACTION: action}, batch_size=[len(state)])
    return names, Demonstrations(data, starts, torch.tensor(driven), replace(wanted, task=task))


def join_demos(parts: Sequence[Demonstrations]) -> Demonstrations:
    """Concatenate several sets of demonstrations in memory, such as those of DAgger's rounds.

    Raises:
        InputError: if there is none, or they differ in what they observe, in its meaning or in sizes.
    """
    shapes = sorted(
        {str({key: part.data[key].shape[1:] for key in part.data.keys(True, True)}) for part in parts}
    )
    if len(shapes) != 1:
        raise InputError(
            f"demos: expected one set of observations and sizes, got {'; '.join(shapes) or 'none'}"
        )
    if len(parts) == 1:
        return parts[0]
    contracts = [part.contract for part in parts if part.contract is not None]
    if len(meanings := sorted({contract.meaning for contract in contracts})) > 1:
        raise InputError(f"demos: expected one meaning of the state, got {'; '.join(meanings)}")
    contract = contracts[0] if len(contracts) == len(parts) else None
    if contract is not None and any(other.task != contract.task for other in contracts):
        contract = replace(contract, task=None)
    lengths = torch.cat([part.starts.diff() for part in parts])
    starts = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    return Demonstrations(
        torch.cat([part.data for part in parts]),
        starts,
        torch.cat([part.driven for part in parts]),
        contract,
    )


def _check_window(horizon: int, n_obs_steps: int, n_action_steps: int) -> None:
    if min(horizon, n_obs_steps, n_action_steps) < 1 or n_obs_steps - 1 + n_action_steps > horizon:
        raise InputError(
            "horizon: expected n_obs_steps >= 1, n_action_steps >= 1 and n_obs_steps - 1 + n_action_steps <= horizon, "
            f"got horizon={horizon}, n_obs_steps={n_obs_steps}, n_action_steps={n_action_steps}"
        )
