"""Execution under inference delay: while the policy computes, the old chunk is executed further.

A policy call takes ``latency`` seconds, in which the environment makes ``ceil(latency * control_freq)`` steps. The answer is
for the step at which it was asked for; once it is there, its actions for the steps that are past are skipped. Others call this
asynchronous inference. What the seam between the chunks is mended with: `RealtimeChunking`, a start of the policy, draws each
call to the actions that play meanwhile; `WarmStart` begins from them; with ``num_samples`` the chunk that goes on best is
played. `RollForward` shows the policy the state in which its answer will begin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.carried import COUNT, Entry
from torchrl_sparse.control.chunk_executor import ChunkExecutor, action_at
from torchrl_sparse.errors import InputError
from torchrl_sparse.policies.diffusion.warm_start import shift_chunk
from torchrl_sparse.rotations import quaternion_to_rot6d


class RealtimeExecutor(ChunkExecutor):
    """`ChunkExecutor` whose new chunks arrive with the policy's inference delay.

    A sample asks the policy every ``n_action_steps`` steps, or as soon as the last answer has come if that takes longer.
    Until the new answer is there the old chunk plays on, and where a chunk has come to its end its last action is held, which
    for absolute poses is a standstill. Before the first answer of an episode the arm is held where it is. With latency 0 all
    actions are those of `ChunkExecutor`.

    Args:
        policy: as for `ChunkExecutor`; ``("cost", "latency")`` is what it took if ``latency`` is None.
        hold: a TensorDictModule that writes ``("control", "hold")``, [*B, A], the action that keeps the arm where it
            is, e.g. `HoldPose`.
        n_action_steps: steps from one call to the next; nothing says that a chunk is long enough for that and the latency.
        latency: seconds that a call takes; None takes each call's own time, as the policy measured it. Rows of a batch
            share a measured time, so measured latencies want batches of one.
        control_freq: steps a second.
        controller: as for `ChunkExecutor`; not heard while an answer is awaited.
        num_samples, selector: as for `ChunkExecutor`.

    Raises:
        InputError: if ``latency`` is negative or not finite, or as in `ChunkExecutor`.

    Examples:
        >>> from torchrl_sparse import DiffusionPolicy, Sampler, make_env
        >>> from torchrl_sparse.envs.tasks import find_robosuite_task
        >>> env = make_env("Lift", seeds=[7])
        >>> policy = DiffusionPolicy.from_pretrained("assets/lift")
        >>> policy.sampler = Sampler("ddim", 10)
        >>> actor = RealtimeExecutor(policy, HoldPose(find_robosuite_task("lift").pose_slices()), latency=0.1)
        >>> env.rollout(3, actor)["control", "delay"].flatten().tolist()
        [2, 2, 2]
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        hold: TensorDictModuleBase,
        n_action_steps: int = 8,
        *,
        latency: float | None = None,
        control_freq: float = 20.0,
        controller: TensorDictModuleBase | None = None,
        num_samples: int = 1,
        selector: TensorDictModuleBase | None = None,
    ):
        super().__init__(policy, n_action_steps, controller, num_samples=num_samples, selector=selector)
        if latency is not None and not (math.isfinite(latency) and latency >= 0):
            raise InputError(f"latency: expected None or seconds >= 0, got {latency}")
        self.hold = hold
        self.latency = latency
        self.control_freq = control_freq

    @property
    def in_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys([*super().in_keys, *self.hold.in_keys]))

    @property
    def out_keys(self) -> list[NestedKey]:
        return [*super().out_keys, keys.DELAY, keys.MEANWHILE]

    def carried(self, chunk: Entry | None) -> dict[NestedKey, Entry]:
        meanwhile = {} if chunk is None else {keys.MEANWHILE: chunk}
        return {**super().carried(chunk), keys.DELAY: COUNT, **meanwhile}

    def _carried_keys(self) -> list[NestedKey]:
        return [*super()._carried_keys(), keys.DELAY, keys.MEANWHILE]

    def _due(self, tensordict: TensorDictBase) -> Tensor:
        awaited = self._age(tensordict) + 1 < self._delay(tensordict)
        return self._begins(tensordict) | (super()._due(tensordict) & ~awaited)

    def _query(self, tensordict: TensorDictBase, due: Tensor) -> None:
        before = tensordict.select(keys.IS_INIT, keys.CHUNK, keys.AGE, strict=False)
        super()._query(tensordict, due)
        tensordict.set(keys.DELAY, torch.where(due, self._new_delay(tensordict), self._delay(tensordict)))
        meanwhile = self._play_on(tensordict, before)
        old = keys.recall(tensordict, keys.MEANWHILE, meanwhile.shape[-2:], 0.0)
        tensordict.set(keys.MEANWHILE, torch.where(due[..., None], meanwhile, old))

    def _expected_delay(self, tensordict: TensorDictBase) -> Tensor:
        """Return i64 [*B, 1]: the latency that is given, else what the latest policy call took."""
        return self._delay(tensordict) if self.latency is None else self._given_delay(tensordict)

    def _given_delay(self, tensordict: TensorDictBase) -> Tensor:
        latency = torch.tensor([self.latency], device=tensordict.device)
        return delay_steps(latency, self.control_freq).expand(*tensordict.batch_size, 1)

    def _delay(self, tensordict: TensorDictBase) -> Tensor:
        """Return i64 [*B, 1]: steps that the latest policy call takes."""
        return keys.recall(tensordict, keys.DELAY, (1,), 0)

    def _new_delay(self, tensordict: TensorDictBase) -> Tensor:
        """Return i64 [*B, 1]: steps that the policy call just made takes."""
        if self.latency is None:
            return delay_steps(keys.read(tensordict, keys.LATENCY), self.control_freq)
        return self._given_delay(tensordict)

    def _play_on(self, tensordict: TensorDictBase, before: TensorDictBase) -> Tensor:
        """Return f32 [*B, n, A]: what is left of the chunk played ``before``; entry 0 is for the present step."""
        chunk = tensordict.get(keys.CHUNK)
        old = keys.recall(before, keys.CHUNK, chunk.shape[-2:], 0.0)
        left = shift_chunk(old, self._age(before) + 1, chunk.shape[-2])
        hold = self.hold(tensordict.select(*self.hold.in_keys)).get(keys.HOLD)
        return torch.where(self._begins(before)[..., None], hold[..., None, :], left)

    def _serve(self, tensordict: TensorDictBase, age: Tensor) -> Tensor:
        there = age >= self._delay(tensordict)
        chunk = tensordict.get(keys.CHUNK)
        playing = torch.where(there[..., None], chunk, tensordict.get(keys.MEANWHILE))
        return action_at(playing, age.clamp(max=chunk.shape[-2] - 1))


class HoldPose(TensorDictModuleBase):
    """Module that writes the absolute action, [*B, 10 * arms], that holds the hands in place with open fingers.

    Args:
        pose_slices: where position and quaternion (xyzw) of each arm lie in ``("observation", "state")``; of a robosuite task,
            `RobosuiteTask.pose_slices`.

    Examples:
        >>> from tensordict import TensorDict
        >>> state = torch.zeros(2, 19)
        >>> state[:, 13] = 1.0  # x of the quaternion: half a turn about x
        >>> hold = HoldPose([(slice(10, 13), slice(13, 17))])
        >>> hold(TensorDict({"observation": {"state": state}}, [2]))["control", "hold"][0].tolist()
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, -1.0]
    """

    in_keys = [keys.STATE]
    out_keys = [keys.HOLD]

    def __init__(self, pose_slices: Sequence[tuple[slice, slice]]):
        super().__init__()
        self._poses = list(pose_slices)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state = keys.read(tensordict, keys.STATE)
        gripper = -torch.ones_like(state[..., :1])
        parts = []
        for position, quaternion in self._poses:
            rotation = quaternion_to_rot6d(state[..., quaternion].cpu().numpy())
            parts += [state[..., position], torch.as_tensor(rotation).to(state), gripper]
        return tensordict.set(keys.HOLD, torch.cat(parts, -1))


def delay_steps(latency: Tensor, control_freq: float = 20.0) -> Tensor:
    """Return the inference delay in environment steps, i64: ``latency`` seconds, rounded up to whole steps.

    >>> delay_steps(torch.tensor([0.0, 0.001, 0.05, 0.051])).tolist()
    [0, 1, 1, 2]
    """
    return (latency.double() * control_freq - 1e-3).ceil().long()  # rounding errors are no delay
