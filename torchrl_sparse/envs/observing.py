"""robosuite's observations, computing only the requested ones and their inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["Observed"]

OBJECTS = "object-state"
"""robosuite's name of all that is observed of objects, one after the other."""


class Observed:
    """What a robosuite environment observes now, to the bits of ``_get_observations(force_update=True)``.

    robosuite's sensors read what others left in a cache. Which ones is found out by a cache that takes notes, once for each set
    of names; then they are updated in robosuite's order, twice where one reads what comes after it.

    Args:
        sim_env: robosuite's environment.
    """

    def __init__(self, sim_env: Any):
        self._sim_env = sim_env
        self._plans: dict[tuple[str, ...], tuple[list[str], int]] = {}

    def read(self, names: Sequence[str]) -> Mapping[str, Any]:
        """Return observations by robosuite's names, `OBJECTS` among them if it is asked for, with the parts that it has.

        Raises:
            KeyError: for a name that it does not have.
        """
        env = self._sim_env
        plan = tuple(names)
        if plan not in self._plans:
            self._plans[plan] = self._plan(plan)
        needed, passes = self._plans[plan]
        observables = [env._observables[name] for name in needed]
        for _ in range(passes):
            for observable in observables:
                observable.update(env.model_timestep, env._obs_cache, force=True)
        found = {each.name: each.obs for each in observables if each.is_enabled() and each.is_active()}
        if OBJECTS in names:
            parts = [np.atleast_1d(found[name]) for name in self._of_objects() if name in found]
            found[OBJECTS] = np.concatenate(parts, axis=-1)
        return found

    def _of_objects(self) -> list[str]:
        return [name for name, each in self._sim_env._observables.items() if each.modality == "object"]

    def _plan(self, names: tuple[str, ...]) -> tuple[list[str], int]:
        """Return which observables are updated, in order, and how often."""
        env = self._sim_env
        order = list(env._observables)
        notes = _Notes(env._obs_cache)
        # As if it were the second time: what a sensor reads may depend on whether it is there.
        env._update_observables(force=True)
        for name, observable in env._observables.items():
            notes.of = name
            observable.update(env.model_timestep, notes, force=True)
        wanted = [part for name in names for part in (self._of_objects() if name == OBJECTS else [name])]
        needed: set[str] = set()
        backwards = False
        while wanted:
            name = wanted.pop()
            if name in needed:
                continue
            place = order.index(env._observables[name].name)
            needed.add(name)
            for key in notes.reads.get(name, ()):
                writers = notes.writers.get(key, set())
                before = {writer for writer in writers if order.index(writer) < place}
                backwards |= bool(writers) and not before
                wanted += before or writers
        return [name for name in order if name in needed], 1 + backwards


class _Notes(dict):
    """A cache of observations that notes what each observable reads and writes."""

    def __init__(self, cache: Mapping[str, Any]):
        super().__init__(cache)
        self.of = ""
        self.reads: dict[str, set[str]] = {}
        self.writers: dict[str, set[str]] = {}

    def __contains__(self, key: object) -> bool:
        self.reads.setdefault(self.of, set()).add(str(key))
        return super().__contains__(key)

    def __getitem__(self, key: str) -> Any:
        self.reads.setdefault(self.of, set()).add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.reads.setdefault(self.of, set()).add(key)
        return super().get(key, default)

    def __setitem__(self, key: str, value: Any) -> None:
        self.writers.setdefault(key, set()).add(self.of)
        super().__setitem__(key, value)
