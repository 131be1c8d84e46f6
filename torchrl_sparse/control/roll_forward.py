"""Delay compensation: a policy that observes a prediction of the state in which its chunk will start.

In a world that does not wait, an answer begins d steps after it was asked for, and what is played until then is known: the rest
of the old chunk. VLASH (arXiv:2512.01031) therefore shows the policy its robot's state rolled forward through those actions, so
that the chunk that comes back is one for the step at which it begins. There the rolled pose is the commanded one, the rest of
the observation stays as it is, and the policy is trained for that mixture. Here the *whole* low-dimensional state is rolled, by
a linear model of one step that demonstrations fit in a second (`StateModel`)::

    s_{j+1} = s_j + W [s_j, s_j - s_{j-1}, a_j, 1],     j = t, ..., t + d - 1

It takes the arm's lag from the demonstrations (a pose that was commanded is reached steps later), objects that move go on as
they did, and what the policy reads is a state like those that it was trained on, so it needs no training. Contact is not
linear: how far the model can be trusted is what `StateModel.errors` measures.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.warm_start import shift_chunk

__all__ = ["RollForward", "StateModel"]

_RIDGE = 1e-2  # of standardised numbers; any from 1e-4 to 1 fits as well
_SMALLEST_DEVIATION = 1e-6  # a number that does not vary predicts nothing


class StateModel(nn.Module):
    """Linear model of one environment step, fitted by ridge regression.

    Args:
        weight: f64 [2 Ds + A + 1, Ds]: what the state, its last change, the action and 1 add to the state.

    Examples:
        >>> state = torch.arange(6.0)[:, None]  # at each step the action is added
        >>> model = StateModel.fit([(state, torch.ones(6, 1))])
        >>> model(torch.tensor([[2.0]]), torch.tensor([[3.0]]), torch.tensor([[1.0]])).round(decimals=3).item()
        4.0
    """

    def __init__(self, weight: Tensor):
        super().__init__()
        self.register_buffer("weight", weight)

    @classmethod
    def fit(cls, episodes: Iterable[tuple[Tensor, Tensor]]) -> StateModel:
        """Fit the model to recorded episodes.

        Args:
            episodes: states [T, Ds] and the actions [T, A] that were taken in them, in environment units.

        Raises:
            InputError: if no episode has the three steps that a change and what comes of it need.
        """
        long_enough = [episode for episode in episodes if len(episode[0]) > 2]
        if not long_enough:
            raise InputError("episodes: expected one of 3 steps or more, got none")
        inputs = torch.cat([_inputs(state[:-2], state[1:-1], action[1:-1]) for state, action in long_enough])
        change = torch.cat([state[2:].double() - state[1:-1].double() for state, _ in long_enough])
        scale = inputs.std(dim=0)
        scale[scale < _SMALLEST_DEVIATION] = torch.inf  # such a column says what that of ones says
        scale[-1] = 1.0
        inputs /= scale
        ridge = _RIDGE * torch.eye(inputs.shape[1], dtype=torch.float64)
        return cls(torch.linalg.solve(inputs.T @ inputs + ridge, inputs.T @ change) / scale[:, None])

    def forward(self, before: Tensor, now: Tensor, action: Tensor) -> Tensor:
        """Return the next state [*B, Ds], from states ``before`` and ``now`` [*B, Ds] and the action [*B, A] taken now."""
        return now + (_inputs(before, now, action) @ self.weight).to(now)

    def errors(self, episodes: Iterable[tuple[Tensor, Tensor]], steps: int) -> tuple[Tensor, Tensor]:
        """Return the errors ``steps`` ahead of the model's prediction and of the unpredicted state, f32 [Ds] each.

        Args:
            episodes: as of `fit`, others than those.
            steps: d >= 1.

        Raises:
            InputError: if no episode is long enough for a single prediction.
        """
        rolled, stale = [], []
        for state, action in episodes:
            if (count := len(state) - 1 - steps) < 1:
                continue
            history = torch.stack([state[:count], state[1 : count + 1]], dim=1)
            for step in range(steps):
                history = self.roll(history, action[1 + step : 1 + step + count])
            after = state[1 + steps :]
            rolled.append((history[:, -1] - after).abs())
            stale.append((state[1 : count + 1] - after).abs())
        if not rolled:
            raise InputError(f"episodes: expected one of more than {steps + 1} steps, got none")
        return torch.cat(rolled).mean(dim=0), torch.cat(stale).mean(dim=0)

    def roll(self, history: Tensor, action: Tensor) -> Tensor:
        """Return the history [*B, To, Ds] one step later, after the action [*B, A]."""
        following = self(history[..., -2, :], history[..., -1, :], action)
        return torch.cat([history[..., 1:, :], following[..., None, :]], dim=-2)


class RollForward(TensorDictModuleBase):
    """Policy whose chunk starts where the inference delay ends; see the module.

    Reads ``("control", "last_chunk")``, ``("control", "elapsed")`` and ``("control", "delay")``, which `RealtimeExecutor` hands
    to a policy that asks for them, and rolls ``("history", "state")`` forward through what plays until the answer is there.
    The first ``delay`` actions of the chunk are those, the answer's own follow, so that entry 0 is for the present step as in
    any policy. An episode's first policy call, which waits at rest, and one without delay, are the policy's own. So is the
    latency that it writes: rolling is not in it.

    Args:
        policy: reads ``("history", "state")``, two observation steps or more, and writes ``("vla_action", "chunk")``.
        model: of its environment.

    Raises:
        InputError: if the policy reads no history of states; at a call, if that is of fewer than two.

    Examples:
        >>> from torchrl_sparse import DiffusionPolicy
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> states, actions = torch.rand(9, 19), torch.rand(9, 10)
        >>> ahead = RollForward(policy, StateModel.fit([(states, actions)]))
        >>> sorted({*map(str, ahead.in_keys)} - {*map(str, policy.in_keys)})
        ["('control', 'delay')", "('control', 'elapsed')", "('control', 'last_chunk')"]
    """

    def __init__(self, policy: TensorDictModuleBase, model: StateModel):
        super().__init__()
        if keys.HISTORY_STATE not in policy.in_keys:
            raise InputError(
                f"policy: expected one that reads {keys.HISTORY_STATE}, got one of {policy.in_keys}"
            )
        self.policy, self.model = policy, model
        self.in_keys = list(dict.fromkeys([*policy.in_keys, keys.LAST_CHUNK, keys.ELAPSED, keys.DELAY]))
        self.out_keys = list(policy.out_keys)

    @property
    def chunk_shape(self) -> tuple[int, int] | None:
        """(n, A) of a chunk, None if the policy does not define it."""
        return getattr(self.policy, "chunk_shape", None)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        elapsed = keys.recall(tensordict, keys.ELAPSED, (1,), 0)
        delay = keys.recall(tensordict, keys.DELAY, (1,), 0).masked_fill(elapsed == 0, 0)
        if not delay.any():
            return self.policy(tensordict)
        history = keys.read(tensordict, keys.HISTORY_STATE)
        if history.shape[-2] < 2:
            raise InputError(
                f"{keys.HISTORY_STATE}: expected 2 observation steps or more, got {history.shape[-2]}"
            )
        old = keys.read(tensordict, keys.LAST_CHUNK)
        meanwhile = shift_chunk(old, elapsed, int(delay.max()))
        answer = self.policy(
            tensordict.copy().set(keys.HISTORY_STATE, self._rolled(history, meanwhile, delay))
        )
        answer.set(keys.HISTORY_STATE, history)
        return answer.set(keys.CHUNK, _begin_after(answer.get(keys.CHUNK), meanwhile, delay))

    def _rolled(self, history: Tensor, meanwhile: Tensor, delay: Tensor) -> Tensor:
        """Return the history [*B, To, Ds] as it is ``delay`` i64 [*B, 1] steps later, each row after its own."""
        for step, action in enumerate(meanwhile.unbind(dim=-2)):
            history = torch.where((step < delay)[..., None], self.model.roll(history, action), history)
        return history


def _inputs(before: Tensor, now: Tensor, action: Tensor) -> Tensor:
    """Return what the model multiplies, f64 [*B, 2 Ds + A + 1]."""
    now = now.double()
    return torch.cat([now, now - before.double(), action.double(), torch.ones_like(now[..., :1])], dim=-1)


def _begin_after(chunk: Tensor, meanwhile: Tensor, delay: Tensor) -> Tensor:
    """Return the chunk [*B, n, A] put off by ``delay`` i64 [*B, 1] steps, in which the actions of ``meanwhile`` are played."""
    index = torch.arange(chunk.shape[-2], device=chunk.device).expand(*delay.shape[:-1], -1)
    put_off = shift_chunk(chunk, -delay, chunk.shape[-2])
    waiting = shift_chunk(meanwhile, torch.zeros_like(delay), chunk.shape[-2])
    return torch.where((index < delay)[..., None], waiting, put_off)
