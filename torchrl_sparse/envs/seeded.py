"""Base of all environments: reproducible episodes by integer seed, success, horizon, and checked actions."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_sparse import keys
from torchrl_sparse.envs.seeds import whole_seed
from torchrl_sparse.errors import InputError

NO_WAY = -1
"""Instead of a way: none showed so far."""

BETWEEN = -2
"""Instead of a way: the episode failed because it went between the ways, as the mean of several does."""


class SeededEnv(EnvBase):
    """Environment with the library's keys, in which one integer fixes each episode.

    An episode is *terminated* on success and *truncated* at the horizon, never both. Its integer, reported under
    ``("episode", "seed")``, is the next of ``seeds``, or one more than the last after `set_seed`.

    Copied or sent to another process, as `MultiSyncCollector` does with one that is ready-made, it is made again from the
    arguments that it was made from, and begins with the first of ``seeds``: no simulator can be sent.

    A subclass makes its specs with `_make_specs` and says how an episode starts (`_start`), goes on (`_advance`), looks
    (`_observe_state`) and whether the task is done (`_is_solved`).

    Attributes:
        action_mode: what an action is, in a word: "absolute" or "delta". A delta beyond the bounds of the action's spec counts
            as the bound.

    Args:
        horizon: steps until truncation.
        seeds: seeds of successive episodes, repeated when used up. For paired evaluations.
        counts_parts: write ``("episode", "completed")``, how many parts of the task were done so far, from `_parts_done`.
        tells_way: write ``("episode", "way")``, which of its ways the task is being done, from `_way`.

    Raises:
        InputError: for an empty ``seeds``, a seed that is no whole number, or an action of a wrong size or that is not finite.
    """

    action_mode: str = "absolute"

    def __new__(cls, *args: Any, **kwargs: Any) -> SeededEnv:
        env = super().__new__(cls, *args, **kwargs)
        env.__dict__["_made_from"] = args, kwargs
        return env

    def __reduce__(self) -> tuple[Any, ...]:
        return _make_anew, (type(self), *self._made_from)

    def __init__(
        self,
        *,
        horizon: int,
        seeds: Sequence[int] | None = None,
        counts_parts: bool = False,
        tells_way: bool = False,
        device: torch.device | str = "cpu",
    ):
        super().__init__(device=device, batch_size=[])
        if seeds is not None and not len(seeds):
            raise InputError("seeds: expected at least one seed, got none")
        self.horizon = horizon
        self._counts_parts, self._tells_way = counts_parts, tells_way
        self._seeds = None if seeds is None else itertools.cycle([whole_seed(seed) for seed in seeds])
        self._next_seed = int(torch.randint(2**31, ()))
        self._episode_seed = self._next_seed
        self._elapsed = 0

    # -- what a subclass says ------------------------------------------------------------------------------------------

    @abstractmethod
    def _start(self, seed: int) -> None:
        """Put the simulator where the episode of ``seed`` begins."""

    @abstractmethod
    def _advance(self, action: np.ndarray) -> float:
        """Take one step under a checked action, f64 of the action spec's shape; return its reward."""

    @abstractmethod
    def _observe_state(self) -> np.ndarray:
        """Return the state, [Ds]."""

    @abstractmethod
    def _is_solved(self) -> bool:
        """Tell whether the task's predicate holds now."""

    def _parts_done(self) -> int:
        """Return parts of the task done so far in this episode."""
        raise NotImplementedError

    def _way(self) -> int:
        """Number, from 0, of the way in which the task is being done in this episode, `NO_WAY` or `BETWEEN`."""
        raise NotImplementedError

    # -- specs ---------------------------------------------------------------------------------------------------------

    def _make_specs(self, state_dim: int, action: Bounded | Unbounded) -> None:
        counts = ["seed", "step"]
        counts += ["completed"] * self._counts_parts + ["way"] * self._tells_way
        self.observation_spec = Composite(
            observation=Composite(state=Unbounded((state_dim,), device=self.device)),
            success=self._flag_spec(),
            episode=Composite({name: self._count_spec() for name in counts}),
        )
        self.action_spec = action.to(self.device)
        self.reward_spec = Unbounded((1,), device=self.device)
        self.done_spec = Composite({name: self._flag_spec() for name in ("done", "terminated", "truncated")})

    def _flag_spec(self) -> Categorical:
        return Categorical(2, (1,), dtype=torch.bool, device=self.device)

    def _count_spec(self) -> Unbounded:
        return Unbounded((1,), dtype=torch.int64, device=self.device)

    # -- episodes ------------------------------------------------------------------------------------------------------

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._next_seed = whole_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        self._episode_seed = self._take_seed()
        self._start(self._episode_seed)
        self._elapsed = 0
        return self._observe()

    def _take_seed(self) -> int:
        if self._seeds is not None:
            return next(self._seeds)
        seed, self._next_seed = self._next_seed, self._next_seed + 1
        return seed

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        reward = self._advance(self._check_action(self._action(tensordict)))
        self._elapsed += 1
        out = self._observe()
        success = out[keys.SUCCESS]
        truncated = (out[keys.EPISODE_STEP] >= self.horizon) & ~success
        out["reward"] = torch.tensor([reward], dtype=torch.float32, device=self.device)
        out["terminated"], out["truncated"], out["done"] = success.clone(), truncated, success | truncated
        return out

    @staticmethod
    def _action(tensordict: TensorDictBase) -> torch.Tensor:
        action = tensordict.get(keys.ACTION, None)
        if action is None and keys.CHUNK in tensordict.keys(True):
            raise InputError(
                "action: expected one, got a chunk of them: an executor is missing, ChunkExecutor(policy), which serves them"
            )
        return keys.read(tensordict, keys.ACTION)

    def _check_action(self, action: torch.Tensor) -> np.ndarray:
        expected = self.action_spec.shape
        if action.shape != expected:
            raise InputError(
                f"action: expected {self.action_mode} shape {tuple(expected)}, got {tuple(action.shape)}"
            )
        action = action.detach().cpu().numpy().astype(np.float64)
        if not np.isfinite(action).all():
            raise InputError(f"action: expected finite numbers, got {action.tolist()}")
        if self.action_mode == "delta":
            bounds = self.action_spec.space
            action = action.clip(bounds.low.cpu().numpy(), bounds.high.cpu().numpy())
        return action

    def _observe(self) -> TensorDict:
        out = TensorDict(device=self.device)
        out[keys.STATE] = torch.as_tensor(self._observe_state(), dtype=torch.float32)
        out[keys.SUCCESS] = torch.tensor([self._is_solved()])
        out[keys.EPISODE_SEED] = torch.tensor([self._episode_seed])
        out[keys.EPISODE_STEP] = torch.tensor([self._elapsed])
        if self._counts_parts:
            out[keys.EPISODE_COMPLETED] = torch.tensor([self._parts_done()])
        if self._tells_way:
            out[keys.EPISODE_WAY] = torch.tensor([self._way()])
        return out


def _make_anew(kind: type[SeededEnv], args: Sequence[Any], kwargs: Mapping[str, Any]) -> SeededEnv:
    return kind(*args, **kwargs)
