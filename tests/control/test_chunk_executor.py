"""Which samples policy call when, what is served in between, and what happens to everything else that a policy writes."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import Compose, InitTracker, TransformedEnv

from tests.counting import CountEnv, counting_policy, episode_length
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.envs.transforms import state_history

NOTE = ("diffusion", "note")


class CountingPolicy(TensorDictModuleBase):
    """Entry i of a chunk is [input, call number, i]; records how many rows each call got."""

    in_keys = ["input"]
    out_keys = [keys.CHUNK, NOTE, keys.FLOPS, keys.LATENCY]

    def __init__(self, length=4):
        super().__init__()
        self.length, self.rows = length, []

    def forward(self, td):
        value = td["input"]
        self.rows.append(value.shape[0] if value.ndim > 1 else 1)
        index = torch.arange(float(self.length)).expand(*value.shape[:-1], self.length)
        call = torch.full_like(index, len(self.rows))
        td[keys.CHUNK] = torch.stack([value.expand_as(index), call, index], -1)
        td[NOTE] = value * 10
        td[keys.FLOPS] = torch.ones_like(value)
        td[keys.LATENCY] = torch.full_like(value, 0.5)
        return td


def step(executor, td, values, is_init):
    batch = td.batch_size
    td["input"] = torch.as_tensor(values, dtype=torch.float32).reshape(*batch, 1)
    td[keys.IS_INIT] = torch.as_tensor(is_init).reshape(*batch, 1)
    return executor(td)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_a_chunk_is_served_in_order_then_queried_again(batch):
    policy = CountingPolicy()
    executor, td = ChunkExecutor(policy, n_action_steps=3), TensorDict(batch_size=batch)
    ages, calls = [], []
    for t in range(7):
        ones = torch.ones(batch)
        td = step(executor, td, ones * t, ones.bool() if t == 0 else ~ones.bool())
        assert td[keys.ACTION].shape == (*batch, 3)
        assert torch.equal(td[keys.ACTION][..., 2], td[keys.AGE][..., 0].float())
        ages.append(int(td[keys.AGE].flatten()[0]))
        calls.append(int(td[keys.ACTION].flatten(0, -2)[0, 1] if batch else td[keys.ACTION][1]))
    assert ages == [0, 1, 2, 0, 1, 2, 0]
    assert calls == [1, 1, 1, 2, 2, 2, 3]


def test_only_due_samples_reach_the_policy_and_others_keep_their_answer():
    policy = CountingPolicy()
    executor, td = ChunkExecutor(policy, n_action_steps=4), TensorDict(batch_size=[3])
    td = step(executor, td, [0.0, 1.0, 2.0], [True, True, True])
    td = step(executor, td, [5.0, 6.0, 7.0], [False, True, False])  # the second one starts a new episode
    assert policy.rows == [3, 1]
    assert td[keys.QUERIED].flatten().tolist() == [False, True, False]
    assert td[keys.AGE].flatten().tolist() == [1, 0, 1]
    assert td[keys.UNTIL_QUERY].flatten().tolist() == [2, 3, 2]
    assert td[keys.ACTION].tolist() == [[0, 1, 1], [6, 2, 0], [2, 1, 1]]
    assert td[NOTE].flatten().tolist() == [0, 60, 20]


def test_costs_count_queries_only():
    executor, td = ChunkExecutor(CountingPolicy(), n_action_steps=4), TensorDict(batch_size=[2])
    td = step(executor, td, [0.0, 0.0], [True, True])
    td = step(executor, td, [0.0, 0.0], [False, True])
    assert td[keys.FLOPS].flatten().tolist() == [0, 1]
    assert td[keys.LATENCY].flatten().tolist() == [0, 0.5]


def test_gate_replans_single_samples_in_the_middle_of_a_chunk():
    controller = TensorDictModule(lambda x: x > 100, in_keys=["input"], out_keys=[keys.REPLAN])
    policy = CountingPolicy()
    executor, td = ChunkExecutor(policy, n_action_steps=4, controller=controller), TensorDict(batch_size=[2])
    td = step(executor, td, [0.0, 0.0], [True, True])
    td = step(executor, td, [0.0, 101.0], [False, False])
    td = step(executor, td, [0.0, 0.0], [False, False])
    assert policy.rows == [2, 1]
    assert td[keys.AGE].flatten().tolist() == [2, 1]
    assert td[keys.UNTIL_QUERY].flatten().tolist() == [0, 0]  # the controller may ask at any step
    assert keys.REPLAN in executor.out_keys


class PayingEnv(CountEnv):
    """Pays 1 for the step that solves it, wherever in a chunk that falls."""

    def _advance(self, action):
        super()._advance(action)
        return float(self._is_solved())


@pytest.mark.parametrize("seed", range(4))  # episodes of 7, 5, 10 and 8 steps
def test_the_reward_of_a_step_inside_a_chunk_is_not_lost(seed):
    """`MultiAction` loses it (findings/torchrl_multiaction_loses_the_last_reward.sh)."""
    executor = ChunkExecutor(counting_policy(4), n_action_steps=4)
    primer = executor.make_tensordict_primer()
    env = TransformedEnv(PayingEnv([seed]), Compose(InitTracker(), *state_history(2), primer))
    steps = env.rollout(20, executor)
    assert len(steps) == episode_length(seed)
    assert steps["next", "reward"].flatten().tolist() == [0.0] * (len(steps) - 1) + [1.0]
    assert steps["next", "terminated"][-1]


def test_every_key_of_the_policy_is_declared():
    executor = ChunkExecutor(CountingPolicy())
    assert {keys.ACTION, keys.AGE, keys.UNTIL_QUERY, keys.QUERIED, *CountingPolicy().out_keys} == set(
        executor.out_keys
    )
    assert set(executor.in_keys) == {keys.IS_INIT, "input"}


def test_missing_init_flag_is_named():
    with pytest.raises(KeyError, match="expected the key 'is_init', got input"):
        ChunkExecutor(CountingPolicy())(TensorDict({"input": torch.zeros(2, 1)}, [2]))


def test_bad_lengths_are_named():
    with refused("n_action_steps"):
        ChunkExecutor(CountingPolicy(), n_action_steps=0)
    with refused("('vla_action', 'chunk')"):
        step(ChunkExecutor(CountingPolicy(), n_action_steps=8), TensorDict(batch_size=[1]), [0.0], [True])
