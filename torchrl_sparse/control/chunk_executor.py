"""Receding-horizon execution: call the policy for a chunk, execute its actions one by one, call again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import (
    COUNT,
    FLAG,
    Entry,
    TensorKeys,
    carried_entries,
    carried_keys,
    check_carried,
    dense,
    make_primer,
    refuse,
)
from torchrl_sparse.control.plain import PlainLoop
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.noise import NOISE_STREAM

if TYPE_CHECKING:
    from torchrl.envs import TensorDictPrimer

# To policies that read them; no environment writes them.
_HANDED_OVER = (keys.LAST_CHUNK, keys.ELAPSED, keys.DELAY)


class ChunkExecutor(TensorKeys, TensorDictModuleBase):
    """Actor that executes a policy's chunks one action per environment step, independently for each sample of a batch.

    A sample asks the policy when its episode begins (``"is_init"``), when ``n_action_steps`` of its chunk are used up, or
    when the controller asks (``("control", "replan")``, see `ActionAwareController`). Only samples that are due are handed to
    the policy. Everything the policy writes stays in the TensorDict until that sample's next call, except costs, which are
    zero on served steps. A policy that reads ``("control", "last_chunk")`` and ``("control", "elapsed")`` is handed the chunk
    of the call before and the steps since, 0 where an episode begins.

    All state is in keys, so it follows the environment through any collector that gives them a place in its spec:
    ``auto_register_policy_transforms=True`` does, or `make_tensordict_primer` by hand. Without TorchRL around it, `reset` and
    `act` are a robot's loop; the state of that one episode is kept here.

    Args:
        policy: writes ``("vla_action", "chunk")``, [*B, n, A], whose entry 0 is for the present step.
        n_action_steps: actions of a chunk that are executed before the next call (Ta).
        controller: a TensorDictModule that may write ``("control", "replan")``; run at every step.
        num_samples: chunks S that a call samples as one batch, of which one is played; the first has the noise of a call that
            samples one. Needs ``("episode", "seed")``. FLOPs are those of all.
        selector: writes ``("control", "chosen")`` given ``("control", "candidates")``, see
            :mod:`torchrl_sparse.control.selectors`; with ``num_samples`` above 1, and only then.

    Raises:
        InputError: if a chunk is shorter than ``n_action_steps``, or the environment drops what a step leaves to the next.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> policy = TensorDictModule(lambda x: x.new_ones(2, 4, 7), in_keys=["x"], out_keys=[keys.CHUNK])
        >>> actor = ChunkExecutor(policy, n_action_steps=4)
        >>> td = actor(TensorDict({"x": torch.zeros(2, 1), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2]))
        >>> td["action"].shape, td["control", "queried"].all().item()
        (torch.Size([2, 7]), True)
    """

    tensor_keys = {"action": keys.ACTION}  # may be named otherwise by `set_keys`

    def __init__(
        self,
        policy: TensorDictModuleBase,
        n_action_steps: int = 8,
        controller: TensorDictModuleBase | None = None,
        *,
        num_samples: int = 1,
        selector: TensorDictModuleBase | None = None,
    ):
        super().__init__()
        if num_samples < 1 or (num_samples > 1) != (selector is not None):
            chosen = "none" if selector is None else type(selector).__name__
            raise InputError(
                f"num_samples: expected 1, or more with a selector, got {num_samples} and {chosen}"
            )
        if n_action_steps < 1:
            raise InputError(f"n_action_steps: expected at least 1, got {n_action_steps}")
        self.policy = policy
        self.n_action_steps = n_action_steps
        self.controller, self.num_samples, self.selector = controller, num_samples, selector
        self._plain: PlainLoop | None = None
        self._written: dict[NestedKey, Entry] = {}  # what the policy writes for one environment

    @property
    def in_keys(self) -> list[NestedKey]:
        controlled = [] if self.controller is None else self.controller.in_keys
        asked = [key for key in self.policy.in_keys if key not in _HANDED_OVER]
        return list(dict.fromkeys([keys.IS_INIT, *controlled, *asked]))

    @property
    def out_keys(self) -> list[NestedKey]:
        chosen = [keys.CHOSEN] if self.selector is not None else []
        own = [self.tensor_keys["action"], keys.AGE, keys.UNTIL_QUERY, keys.QUERIED, *chosen]
        controlled = [] if self.controller is None else self.controller.out_keys
        return list(dict.fromkeys([*own, *controlled, *self.policy.out_keys]))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_carried(tensordict)
        if self.controller is not None:
            tensordict = self.controller(tensordict)
        due = self._due(tensordict)
        if due.any():
            self._query(tensordict, due)
        else:
            self._complete(tensordict)
        self._clear_costs(tensordict, ~due)
        age = torch.where(due, 0, self._age(tensordict) + 1)
        tensordict.set(keys.AGE, age)
        tensordict.set(keys.UNTIL_QUERY, self._until_query(age))
        tensordict.set(keys.QUERIED, due)
        return tensordict.set(self.tensor_keys["action"], self._serve(tensordict, age))

    def make_tensordict_primer(self, chunk_shape: tuple[int, int] | None = None) -> TensorDictPrimer:
        """Return the transform that adds all keys carried by this actor to an environment's spec.

        Collectors find and append it by themselves with ``auto_register_policy_transforms=True``.

        Args:
            chunk_shape: (n, A) of a chunk, where the policy has no ``chunk_shape``, as the library's own do. Where nobody says
                it, the chunk is left out; it then follows any environment but a bare `ParallelEnv` or one within it.

        Examples:
            >>> from tensordict.nn import TensorDictModule
            >>> from torchrl_sparse import DiffusionPolicy
            >>> actor = ChunkExecutor(DiffusionPolicy.from_pretrained("assets/lift"))
            >>> sorted(actor.make_tensordict_primer().primers.keys(True, True))
            [('control', 'age'), ('control', 'queried'), ('vla_action', 'chunk')]
        """
        shape = getattr(self.policy, "chunk_shape", None) if chunk_shape is None else chunk_shape
        return make_primer(carried_entries(self, None if shape is None else Entry(tuple(shape))))

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        """Return the spec of the executor's own carried keys, see :mod:`torchrl_sparse.carried`."""
        age = COUNT._replace(begin=-1)
        return {keys.AGE: age, keys.QUERIED: FLAG, **({} if chunk is None else {keys.CHUNK: chunk})}

    def _carried_keys(self) -> list[NestedKey]:
        controlled = [] if self.controller is None else carried_keys(self.controller)
        return [keys.QUERIED, keys.CHUNK, *controlled, *carried_keys(self.policy)]

    def _check_carried(self, tensordict: TensorDictBase) -> None:
        """Raise InputError where an environment dropped what the step before left, or hands zeros back in its place."""
        going_on = ~keys.read(tensordict, keys.IS_INIT)
        if not going_on.any():
            return
        check_carried(tensordict, [keys.AGE], going_on)
        age = self._age(tensordict)
        going_on = going_on & (age >= 0)  # another policy may have begun the episode
        check_carried(tensordict, self._carried_keys(), going_on)
        asked = keys.recall(tensordict, keys.QUERIED, (1,), False)
        refuse(keys.AGE, going_on & ~asked & (age == 0))

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode of `act`: the next observation is its first.

        Args:
            seed: of the noise, the same as in an environment's episode of this seed; None for torch's global generator.

        Raises:
            InputError: if the policy is none that observes a state, such as a VLA.
        """
        self._plain = PlainLoop(self, seed)

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the action f32 [A] of the current step of a plain loop, for one robot.

        Args:
            observation: ``"state"``, numbers [Ds] of any real dtype, laid out and in the version of robosuite that
                `DiffusionPolicy.describe` says, for nothing here can tell one from another; ``"image"``
                and ``"wrist_image"``, u8 [h, w, 3] or [3, h, w], where the policy has cameras; ``"eef_vel"``, m/s and rad/s,
                for an `ActionAwareController`. Histories are kept here.

        Raises:
            InputError: naming what is missing, unknown, or of another dtype or shape; nothing is kept of that observation.

        Examples:
            >>> from torchrl_sparse import DiffusionPolicy, Sampler
            >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
            >>> policy.sampler = Sampler("ddim", 2)
            >>> actor = ChunkExecutor(policy)
            >>> actor.reset(seed=0)
            >>> actor.act({"state": np.zeros(19)}).shape
            (10,)
        """
        if self._plain is None:
            self._plain = PlainLoop(self, None)
        return self._plain.act(observation)

    def _age(self, tensordict: TensorDictBase) -> Tensor:
        """Return i64 [*B, 1]: position in the chunk of the action served last; -1 where there is no chunk yet."""
        return keys.recall(tensordict, keys.AGE, (1,), -1)

    def _begins(self, tensordict: TensorDictBase) -> Tensor:
        """Return bool [*B, 1]: samples without a chunk of this episode."""
        return keys.read(tensordict, keys.IS_INIT) | (self._age(tensordict) < 0)

    def _until_query(self, age: Tensor) -> Tensor:
        """Return i64 [*B, 1]: steps from the next observation to the next policy call at the earliest."""
        left = (self.n_action_steps - 1 - age).clamp(min=0)
        return left if self.controller is None else torch.zeros_like(left)  # which may ask at any step

    def _due(self, tensordict: TensorDictBase) -> Tensor:
        """Return bool [*B, 1]: samples without an action to serve."""
        due = self._begins(tensordict) | (self._age(tensordict) + 1 >= self.n_action_steps)
        replan = tensordict.get(keys.REPLAN, None)
        return due if replan is None else due | replan

    def _query(self, tensordict: TensorDictBase, due: Tensor) -> None:
        """Run the policy on the due samples alone and write what it returns into their rows."""
        batch = tensordict.batch_size
        index = due.reshape(-1).nonzero().squeeze(-1)
        answer = self._ask(self._request(tensordict).reshape(-1)[index])
        length = answer.get(keys.CHUNK).shape[-2]
        if length < self.n_action_steps:
            raise InputError(
                f"{keys.CHUNK}: expected at least n_action_steps={self.n_action_steps} actions, got {length}"
            )
        for key in (*self.policy.out_keys, *([keys.CHOSEN] if self.selector is not None else ())):
            value = answer.get(key)
            shape = value.shape[1:]
            self._written[key] = Entry(tuple(shape), value.dtype)
            whole = keys.recall(tensordict, key, shape, 0, value.dtype).reshape(-1, *shape)
            tensordict.set(key, whole.index_copy(0, index, value).reshape(*batch, *shape))

    def _complete(self, tensordict: TensorDictBase) -> None:
        """Write zeros for what an environment did not hand back of the last answer, so that each step has the same keys."""
        for key, entry in self._written.items():
            if tensordict.get(key, None) is None:
                tensordict.set(key, keys.recall(tensordict, key, entry.shape, 0, entry.dtype))

    def _request(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return all that the policy reads, with the last chunk if it asks for that."""
        wanted = [*self.policy.in_keys, *(self.selector.in_keys if self.selector is not None else ())]
        request = tensordict.select(*wanted, strict=False)
        if keys.ELAPSED in wanted:
            elapsed = self._age(tensordict) + 1
            request.set(keys.ELAPSED, elapsed.masked_fill(keys.read(tensordict, keys.IS_INIT), 0))
        if keys.LAST_CHUNK in wanted:
            request.set(keys.LAST_CHUNK, keys.recall(tensordict, keys.CHUNK, (1, 1), 0.0))
        if keys.DELAY in wanted:
            request.set(keys.DELAY, self._expected_delay(tensordict))
        return dense(request, self.policy)

    def _expected_delay(self, tensordict: TensorDictBase) -> Tensor:
        """Return i64 [*B, 1]: steps that a policy call asked now will take; none in a world that waits."""
        return torch.zeros_like(self._age(tensordict))

    def _ask(self, request: TensorDictBase) -> TensorDictBase:
        """Return the policy's answers to policy calls [n], each the chosen one of its samples."""
        if self.selector is None:
            return self.policy(request)
        rows, samples = len(request), self.num_samples
        asked = request.repeat_interleave(samples, dim=0)
        stream = torch.arange(samples, device=asked.device).repeat(rows)[:, None]
        asked.set(keys.EPISODE_SEED, keys.read(asked, keys.EPISODE_SEED).long() + stream * NOISE_STREAM)
        answers = self.policy(asked).reshape(rows, samples)
        request.set(keys.CANDIDATES, answers.get(keys.CHUNK))
        chosen = self.selector(request).get(keys.CHOSEN)
        answer = answers[torch.arange(rows), chosen.squeeze(-1)]
        if keys.FLOPS in self.policy.out_keys:
            answer.set(keys.FLOPS, answers.get(keys.FLOPS).sum(dim=1))
        return answer.set(keys.CHOSEN, chosen)

    def _serve(self, tensordict: TensorDictBase, age: Tensor) -> Tensor:
        """Return the action [*B, A] of this step."""
        return action_at(tensordict.get(keys.CHUNK), age)

    def _clear_costs(self, tensordict: TensorDictBase, served: Tensor) -> None:
        for key in (keys.FLOPS, keys.LATENCY):
            if key in self.policy.out_keys:
                spent = keys.recall(tensordict, key, (1,), 0.0)
                tensordict.set(key, spent.masked_fill(served, 0.0))


def action_at(chunk: Tensor, age: Tensor) -> Tensor:
    """Return the action [*B, A] at position ``age`` [*B, 1] of ``chunk`` [*B, n, A]."""
    index = age[..., None].expand(*age.shape, chunk.shape[-1])
    return chunk.gather(-2, index).squeeze(-2)
