"""What a client asks: its observation, under the names that the policy's contract or openpi's clients have, and its episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchrl_sparse.envs.contract import Contract
from torchrl_sparse.envs.tasks import RobosuiteTask, find_task
from torchrl_sparse.errors import InputError

__all__ = ["Request", "RequestReader"]

_PREFIXES = ("observation/", "images/", "image/")
_DEPTH = 4
_SEEDS = 2**31


@dataclass(frozen=True)
class Request:
    """One request of a client.

    Attributes:
        observation: arrays by the policy's own names.
        reset: it begins an episode.
        seed: of the noise of the episode that begins; None for the server's.
    """

    observation: Mapping[str, np.ndarray]
    reset: bool = False
    seed: int | None = None


@dataclass(frozen=True)
class RequestReader:
    """Reads requests.

    Names may be flat, ``"observation/state"``, or nested, ``{"observation": {"state": ...}}``. The state comes whole, or by the
    names that the contract has for its parts; a camera by its name here or in the demonstrations. ``"prompt"`` is for policies
    that read instructions and ignored. ``"episode/reset"``, true, begins an episode, ``"episode/seed"`` says its noise.

    Attributes:
        contract: of the policy; None where its task is not known.

    Raises:
        InputError: naming the entry that is unknown, there twice, or no array.

    >>> reader = RequestReader(None)
    >>> reader({"observation/state": np.zeros(2), "prompt": "lift", "episode": {"seed": 3, "reset": True}})
    Request(observation={'state': array([0., 0.])}, reset=True, seed=3)
    """

    contract: Contract | None
    _sizes: dict[str, int | None] = field(init=False)
    _cameras: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        contract = self.contract
        parts = () if contract is None else contract.state_keys
        task = None if contract is None or contract.task is None else find_task(contract.task)
        sizes = {
            part: task.state_size((part,)) if isinstance(task, RobosuiteTask) else None for part in parts
        }
        object.__setattr__(self, "_sizes", sizes)
        named = {} if contract is None else {there: here for here, there in contract.cameras.items()}
        object.__setattr__(self, "_cameras", named)

    def __call__(self, content: Any) -> Request:
        """Return what a message asks."""
        if not isinstance(content, dict):
            raise InputError(f"message: expected a map of an observation, got {type(content).__name__}")
        entries: dict[str, Any] = {}
        for name, value in _flat(content, ""):
            plain = self._plain(name)
            if plain in entries:
                raise InputError(f"{name}: expected one {plain}, got two")
            entries[plain] = value
        reset, seed = entries.pop("episode/reset", False), entries.pop("episode/seed", None)
        if not isinstance(reset, (bool, np.bool_)):
            raise InputError(f"episode/reset: expected true or false, got {reset!r:.60}")
        if seed is not None and not (_whole(seed) and 0 <= seed < _SEEDS):
            raise InputError(
                f"episode/seed: expected a whole number from 0 to {_SEEDS - 1}, got {seed!r:.60}"
            )
        if not isinstance(entries.pop("prompt", ""), str):
            raise InputError("prompt: expected text, got something else")
        for name, value in entries.items():
            if not isinstance(value, np.ndarray):
                raise InputError(f"{name}: expected an array, got {type(value).__name__}")
        return Request(self._joined(entries), bool(reset), None if seed is None else int(seed))

    def _plain(self, name: str) -> str:
        for prefix in _PREFIXES:
            name = name.removeprefix(prefix)
        return self._cameras.get(name, name)

    def _joined(self, entries: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the entries, with the state in one where it came in parts."""
        if not self._sizes.keys() & entries.keys() or "state" in self._sizes:
            return entries
        if missing := [part for part in self._sizes if part not in entries]:
            raise InputError(f"{missing[0]}: expected an array, got none, though other parts of the state")
        parts = [entries.pop(part) for part in self._sizes]
        for (name, size), part in zip(self._sizes.items(), parts, strict=True):
            if part.ndim == 0 or part.shape[:-1] != parts[0].shape[:-1] or size not in (None, part.shape[-1]):
                expected = "numbers" if size is None else f"{size} numbers"
                raise InputError(
                    f"{name}: expected {expected} of as many steps as others, got shape {part.shape}"
                )
        return {**entries, "state": np.concatenate(parts, axis=-1)}


def _whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _flat(content: dict[Any, Any], prefix: str, depth: int = 1) -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if not isinstance(name, str):
            raise InputError(f"message: expected names that are text, got {name!r:.60}")
        if isinstance(value, dict) and depth == _DEPTH:
            raise InputError(f"{prefix}{name}: expected at most {_DEPTH} levels of maps, got more")
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}/", depth + 1)
        else:
            yield f"{prefix}{name}", value
