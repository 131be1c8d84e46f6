"""One client's episode: its history, its chunk, what policy calls leave to the next, and the noise of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import Entry, carried_entries
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.plain import PlainLoop
from torchrl_sparse.errors import InputError
from torchrl_sparse.serving.requests import Request

__all__ = ["Answers", "Robot", "RobotSetup", "Row", "first_request"]

Row = dict[NestedKey, Tensor]
"""What the executor reads of one client, or leaves to it, by key; TensorDicts are made of whole batches."""
Answers = Literal["action", "chunk"]
"""What a request is answered with: the action of one control step, or the chunk of one policy call."""


class RobotSetup:
    """What all clients of an executor share, read once.

    Args:
        executor: its chunks' executor.
        answers: see `Answers`. For chunks the executor must call at each step, and a client shows a history, [To, ...], itself.
        seed: of the noise of each client's first episode; the next has the next.

    Raises:
        InputError: if the policy reads no state, or chunks are asked of a method that reads the chunk before.
    """

    def __init__(self, executor: ChunkExecutor, answers: Answers, seed: int):
        if answers not in get_args(Answers):
            raise InputError(f"answers: expected one of {', '.join(get_args(Answers))}, got {answers!r}")
        self.names = PlainLoop(executor, seed).names  # which refuses what no robot's loop can ask
        self.executor, self.answers, self.seed = executor, answers, seed
        self.chunk_shape: tuple[int, int] = executor.policy.chunk_shape
        self.n_obs_steps: int = executor.policy.n_obs_steps
        wanted = {*executor.policy.in_keys, *(executor.selector.in_keys if executor.selector else ())}
        if answers == "chunk" and (
            wanted & {keys.LAST_CHUNK, keys.ELAPSED} or executor.controller is not None
        ):
            raise InputError(
                "answers: expected action for a method that reads its last chunk or has a controller, got chunk"
            )
        self._entries = carried_entries(executor, Entry(self.chunk_shape))
        self.action: NestedKey = executor.tensor_keys["action"]
        self._wanted = list(dict.fromkeys([*self._entries, keys.CHUNK, keys.UNTIL_QUERY, self.action]))
        self.carried = [*self._entries]

    def begin(self) -> Row:
        """Return what an environment's reset writes of the keys that steps leave to each other."""
        entries = self._entries.items()
        return {key: torch.full(one.shape, one.begin, dtype=one.dtype) for key, one in entries}

    def ask(self, rows: Sequence[Row]) -> list[Row]:
        """Run the executor on what several clients read, as one batch, and return what it leaves to each."""
        stacked = {key: torch.stack([row[key] for row in rows]) for key in rows[0]}
        left = self.executor(TensorDict(stacked, [len(rows)]).to(self.executor.policy.device))
        columns = [left.get(key).cpu().unbind(0) for key in self._wanted]
        return [dict(zip(self._wanted, row, strict=True)) for row in zip(*columns, strict=True)]


class Robot:
    """One client. `take` a request; where that returns no answer, `keep` what the executor left of what it returned.

    Args:
        setup: of all clients.
    """

    def __init__(self, setup: RobotSetup):
        self._setup, self._episode = setup, -1
        self._loop: PlainLoop | None = None
        self._until, self._age = 0, -1  # steps whose actions are in the chunk; the position of the last one
        self._left: Row = {}

    def take(self, request: Request) -> np.ndarray | Row:
        """Return the answer where the chunk holds it, else what the executor reads of this step.

        Raises:
            InputError: naming the entry that does not fit.
        """
        if request.reset or self._loop is None:
            self._begin(request.seed)
        elif request.seed is not None:
            raise InputError(
                "episode/seed: expected it with episode/reset or first of all, got it in mid-episode"
            )
        assert self._loop is not None
        self._loop.remember(*self._steps(request))
        if self._until > 0:
            self._until, self._age = self._until - 1, self._age + 1
            self._loop.advance()
            return self._chunk[self._age : self._age + 1]
        if not self._left:
            return {**self._setup.begin(), **self._loop.reads()}
        played = {keys.AGE: torch.tensor([self._age]), keys.QUERIED: torch.tensor([self._age == 0])}
        return {**self._left, **played, **self._loop.reads()}

    def keep(self, left: Row) -> np.ndarray:
        """Return the answer, f32 [1, A] or [n, A], from what the executor left.

        Raises:
            InputError: if it is not finite, which only an observation far from all demonstrations has led to.
        """
        assert self._loop is not None
        chunk = left[keys.CHUNK].numpy()
        if not np.isfinite(chunk).all():
            raise InputError("observation: expected one with a finite answer, got one without")
        self._chunk, self._age = chunk, int(left[keys.AGE])
        self._left = {key: left[key] for key in self._setup.carried}
        self._loop.advance()
        if self._setup.answers == "chunk":
            return chunk
        self._until = int(left[keys.UNTIL_QUERY])
        return left[self._setup.action][None].numpy()

    def _begin(self, seed: int | None) -> None:
        self._episode += 1
        self._loop = PlainLoop(
            self._setup.executor, self._setup.seed + self._episode if seed is None else seed
        )
        self._left, self._until, self._age = {}, 0, -1

    def _steps(self, request: Request) -> list[dict[str, np.ndarray]]:
        """Return the observations of a request, oldest first."""
        count = self._setup.n_obs_steps
        if self._setup.answers == "action" or count == 1:
            return [dict(request.observation)]
        for name, value in request.observation.items():
            if value.ndim == 0 or len(value) != count:
                raise InputError(
                    f"{name}: expected the last {count} steps, oldest first, got shape {value.shape}"
                )
        return [{name: value[step] for name, value in request.observation.items()} for step in range(count)]


def first_request(setup: RobotSetup) -> Row | None:
    """Return what the executor reads where all that is observed is 0; None where it reads more than a state and cameras."""
    policy = setup.executor.policy
    zeros = {"state": np.zeros(policy.normalizer.state_scale.numel())}
    for name in () if policy.vision is None else policy.vision.cameras:
        zeros[name] = np.zeros((3, *policy.vision.image_size), np.uint8)
    if setup.names != zeros.keys():
        return None
    count = setup.n_obs_steps if setup.answers == "chunk" and setup.n_obs_steps > 1 else None
    shown = {name: value if count is None else np.stack([value] * count) for name, value in zeros.items()}
    row = Robot(setup).take(Request(shown))
    assert not isinstance(row, np.ndarray)
    return row
