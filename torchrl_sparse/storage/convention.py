"""The robosuite version, from a policy's ``source``, that defines the meaning of its observations.

The conventions and the conversion between them are in `torchrl_sparse.envs.conventions`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal

from torchrl_sparse.errors import InputError

__all__ = ["Convention", "source_convention", "version_convention"]

Convention = Literal["1.5", "1.4"]
"""The last version of robosuite whose meaning the observations have."""


def source_convention(source: Mapping[str, Any]) -> Convention:
    """Return the convention in a policy's ``source``, see `torchrl_sparse.storage.diffusion.StoredPolicy`.

    Policies that were trained here have the present one. An imported one has that of its ``"robosuite"``, a version; without
    it, that of robosuite 1.2, which the published code installs.

    >>> source_convention({}), source_convention({"weights": "ema_model", "robosuite": "1.4.1"})
    ('1.5', '1.4')
    """
    try:
        return version_convention(source.get("robosuite") or ("1.2" if "weights" in source else "1.5"))
    except ValueError as error:
        raise InputError(f"policy.source['robosuite']: {error}") from error


def version_convention(version: str) -> Convention:
    """Return the convention of a robosuite version; ValueError for an invalid version.

    >>> version_convention("1.4.1"), version_convention("1.10")
    ('1.4', '1.5')
    """
    numbers = re.match(r"(\d+)\.(\d+)", version)
    if numbers is None:
        raise InputError(f"expected a version such as 1.4.1, got {version!r}")
    return "1.4" if tuple(map(int, numbers.groups())) < (1, 5) else "1.5"
