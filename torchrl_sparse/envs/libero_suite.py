"""A LIBERO suite as one environment: its ten tasks in turn, each episode fixed by its seed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, InitTracker, TransformedEnv

from torchrl_sparse import keys
from torchrl_sparse.envs.libero import make_libero_env, suite_horizon
from torchrl_sparse.envs.seeded import SeededEnv
from torchrl_sparse.envs.seeds import FIRST_TEST_SEED, evaluation_seeds
from torchrl_sparse.errors import InputError

__all__ = ["LiberoSuite", "make_suite_env", "scene_of"]

_TASKS, _STATES = 10, 50  # of a suite, and initial states of a task
_FIRST = evaluation_seeds("test", 0, 1)[0]
_SHOWN = (keys.IMAGE, keys.WRIST_IMAGE, keys.EEF_VEL, keys.INSTRUCTION)


def scene_of(seed: int) -> tuple[int, int | None]:
    """Return an episode's task and the index of its initial state in that task; None if the seed draws the state.

    The i-th test seed is task i modulo 10 in state i // 10. So 500 episodes are those of the published evaluations, each state
    of each task once, and there are no more. On seeds for tuning LIBERO's own samplers place the objects, so that no state of
    the test is seen before.

    Raises:
        InputError: for a test seed beyond the 500.

    >>> scene_of(210_000), scene_of(210_013), scene_of(100_013)
    ((0, 0), (3, 1), (3, None))
    """
    if seed < FIRST_TEST_SEED:
        return seed % _TASKS, None
    state, task = divmod(seed - _FIRST, _TASKS)
    if not 0 <= state < _STATES:
        last = _FIRST + _TASKS * _STATES - 1
        raise InputError(
            f"seed: expected test seeds from {_FIRST} to {last}, as many as a suite of LIBERO has initial states, got {seed}"
        )
    return task, state


def make_suite_env(suite: str, **kwargs: Any) -> TransformedEnv:
    """Make a `LiberoSuite` with ``"is_init"`` at the start of episodes; ``kwargs`` are passed to it."""
    return TransformedEnv(LiberoSuite(suite, **kwargs), Compose(InitTracker()))


class LiberoSuite(SeededEnv):
    """All tasks of a LIBERO suite, with the observations of `make_libero_env`, a state f32 [8] and normalised actions.

    An episode is what `scene_of` says, and what a reset draws beside it (where cabinets and stoves stand) comes of its seed
    too. The simulator is made again where the task changes, so as many environments as tasks, each with every tenth seed, spare
    that.

    Args:
        suite: one of `torchrl_sparse.envs.libero.SUITES`.
        image_size, as_released: see `make_libero_env`.
        horizon: steps until truncation; by default those of the published evaluation.
        seeds: see `SeededEnv`.

    Raises:
        ImportError: without LIBERO, with the command that installs it.
        InputError: on an unknown suite, or a seed that `scene_of` refuses.
    """

    action_mode = "delta"

    def __init__(
        self,
        suite: str,
        *,
        image_size: int = 224,
        as_released: bool = False,
        horizon: int | None = None,
        seeds: Sequence[int] | None = None,
    ):
        scenes = [scene_of(seed) for seed in seeds or ()]
        self._make_task = partial(
            make_libero_env, suite, image_size=image_size, as_released=as_released, init_state_mode="fixed"
        )
        super().__init__(horizon=suite_horizon(suite) if horizon is None else horizon, seeds=seeds)
        self._scene = self._make_task(scenes[0][0] if scenes else 0)
        self._now: TensorDictBase = TensorDict()
        self._make_specs(8, self._scene.action_spec)
        observation = self.observation_spec
        for key in _SHOWN:
            observation[key] = self._scene.observation_spec[key]
        self.observation_spec = observation

    def _start(self, seed: int) -> None:
        task, state = scene_of(seed)
        if task != self._scene.base_env.task_id:
            self._scene.close()
            self._scene = self._make_task(task)
        simulator = self._scene.base_env
        simulator.scene_seed, simulator.init_state_id = seed, state
        self._now = self._scene.reset()

    def _advance(self, action: np.ndarray) -> float:
        command = torch.as_tensor(action, dtype=torch.float32)
        stepped = self._scene.step(self._now.set(keys.ACTION, command))
        self._now = self._scene.step_mdp(stepped)
        return float(stepped["next", "reward"])

    def _observe_state(self) -> np.ndarray:
        return self._now[keys.STATE].numpy()

    def _is_solved(self) -> bool:
        return bool(self._now[keys.SUCCESS])

    def _observe(self) -> TensorDict:
        return super()._observe().update(self._now.select(*_SHOWN))

    def close(self, *, raise_if_closed: bool = True) -> Any:
        self._scene.close()
        return super().close(raise_if_closed=raise_if_closed)
