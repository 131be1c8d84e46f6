"""The objects' state of a demonstration file in the convention that a reader wants, whichever robosuite recorded it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torchrl_sparse.data.hdf5_bounds import text_attribute
from torchrl_sparse.envs.conventions import Convention, translate_objects, version_convention
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask

__all__ = ["RecordedObjects"]


class RecordedObjects:
    """Translates what an open demonstration file recorded.

    A file says by ``env_version`` of its ``env_args`` which robosuite recorded it, or by the form of its controller, which is
    another since 1.5. One that says neither is taken for one of the present convention, and for no other.

    Args:
        path: of the file.
        file: the open file.
        task: name of the task that is read; None for what the file says.

    Attributes:
        task: name of the task; None if the file names none that is known here.
    """

    def __init__(self, path: str | Path, file: h5py.File, task: str | None) -> None:
        self._path = path
        args = _env_args(path, file)
        named = args.get("env_name")
        self.task = task or (named if isinstance(named, str) and named in TASKS else None)
        self._version, self._kwargs = args.get("env_version"), args.get("env_kwargs")

    def translate(self, where: str, state: np.ndarray, wanted: Convention) -> np.ndarray:
        """Return the objects' state [T, object_dim] as ``wanted`` has it.

        Raises:
            ValueError: naming what was recorded and what is wanted, if there is no translation.
        """
        if not isinstance(TASKS.get(self.task or ""), RobosuiteTask):
            return state
        recorded = self._convention()
        if recorded is None and wanted != "1.5":
            raise ValueError(
                f"{self._path}: expected env_args that tell which robosuite recorded the objects, which the policy observes "
                f"as robosuite {wanted} did, got none"
            )
        try:
            return translate_objects(str(self.task), state, observed=recorded or "1.5", wanted=wanted)
        except ValueError as error:
            told = f"recorded as of robosuite {recorded or '1.5'}, wanted as of {wanted}"
            raise ValueError(f"{where}, object: {told}: {error}") from error

    def _convention(self) -> Convention | None:
        if isinstance(self._version, str):
            try:
                return version_convention(self._version)
            except ValueError as error:
                raise ValueError(f"{self._path}, env_args: env_version: {error}") from error
        controller = self._kwargs.get("controller_configs") if isinstance(self._kwargs, Mapping) else None
        if isinstance(controller, list):  # one for each arm, up to 1.4
            controller = controller[0] if controller else None
        if not isinstance(controller, Mapping):
            return None
        return "1.5" if "body_parts" in controller else "1.4"


def _env_args(path: str | Path, file: h5py.File) -> Mapping[str, Any]:
    with suppress(
        ValueError, RecursionError
    ):  # what is wrong with it, `read_control` says where it is needed
        args = json.loads(text_attribute(str(path), file["data"], "env_args") or "{}")
        if isinstance(args, dict):
            return args
    return {}
