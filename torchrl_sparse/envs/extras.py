"""Imports of simulators that are optional extras."""

from __future__ import annotations

import io
import os
from contextlib import redirect_stderr
from importlib import import_module
from types import ModuleType

from torchrl_sparse.envs.simulator import cv2_or_stand_in

__all__ = ["import_extra"]


def import_extra(module: str, extra: str) -> ModuleType:
    """Import a module of an optional simulator, even where no GL library is installed.

    Raises:
        ImportError: without it, with the command that installs it.

    >>> import_extra("nothing", "pusht")
    Traceback (most recent call last):
    ...
    ImportError: nothing needs the extra pusht, pip install 'torchrl-sparse[pusht]': No module named 'nothing'
    """
    os.environ.setdefault("MUJOCO_GL", "egl")  # only used if something is rendered
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        with cv2_or_stand_in(), redirect_stderr(io.StringIO()):  # simulators greet there
            return import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{module} needs the extra {extra}, pip install 'torchrl-sparse[{extra}]': {error}"
        ) from error
