"""Chunks that go on from the last: how far each action is drawn, per sample, and who says how late an answer is."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, RealtimeChunking, RealtimeExecutor, Sampler, keys
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.policies.diffusion.realtime_chunking import chunk_pull

ENGINES = ["reference", "torch", *(["native"] if native_available()[0] else [])]


def equation_5(i, delay, end):
    if i < delay:
        return 1.0
    if i >= end:
        return 0.0
    c = (end - i) / (end - delay + 1)
    return c * (math.exp(c) - 1) / (math.e - 1)


def test_actions_are_drawn_as_the_paper_says():
    cases = [(delay, left) for delay in range(8) for left in range(-3, 8)]
    delay, left = (torch.tensor(column)[:, None] for column in zip(*cases, strict=True))
    expected = [[equation_5(i, *case) for i in range(6)] for case in cases]
    torch.testing.assert_close(chunk_pull(delay, left, 6), torch.tensor(expected), rtol=0, atol=1e-6)


@pytest.fixture
def asked():
    """Policy calls at the beginning of an episode, and 1, 3, 3 and 9 steps after the one before."""
    generator = torch.Generator().manual_seed(0)
    query = {
        keys.HISTORY_STATE: torch.randn(5, 2, 5, generator=generator),
        keys.EPISODE_SEED: torch.arange(5)[:, None],
        keys.EPISODE_STEP: torch.arange(5)[:, None],
        keys.LAST_CHUNK: 0.4 * torch.rand(5, 5, 4, generator=generator),
        keys.ELAPSED: torch.tensor([[0], [1], [3], [3], [9]]),
        keys.DELAY: torch.tensor([[2], [2], [1], [0], [2]]),
    }
    return TensorDict(query, [5])


@pytest.mark.parametrize("engine", ENGINES)
def test_what_plays_meanwhile_begins_the_new_chunk(policy, asked, engine):
    policy.engine, policy.start = engine, RealtimeChunking()
    answered = policy(asked.clone())
    for row in range(5):
        elapsed, delay = int(asked[keys.ELAPSED][row]), int(asked[keys.DELAY][row])
        pull = answered[keys.PULL][row, :, 0].tolist()
        left = 5 - elapsed if elapsed else 0
        expected = [equation_5(i, delay if elapsed else 0, left) for i in range(5)]
        assert pull == pytest.approx([0.0, *expected], abs=1e-6)  # the first is of the observation before
        if elapsed:
            played = [asked[keys.LAST_CHUNK][row, min(elapsed + i, 4)] for i in range(delay)]
            begins = answered[keys.CHUNK][row, :delay]
            torch.testing.assert_close(begins, torch.stack(played) if played else begins, rtol=0, atol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_actions_behind_them_follow(policy, asked, engine):
    """They know what plays through the network: another beginning is another continuation."""
    policy.engine, policy.start = engine, RealtimeChunking()
    asked[keys.ELAPSED][:], asked[keys.DELAY][:] = 4, 1  # a single action is left, and certain
    one = policy(asked.clone())[keys.CHUNK]
    asked[keys.LAST_CHUNK][:, 4] *= -1
    other = policy(asked.clone())[keys.CHUNK]
    assert ((one - other)[:, 1:].abs().amax(dim=(1, 2)) > 1e-4).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_a_row_is_the_row_alone_and_without_a_last_chunk_free(policy, asked, engine):
    policy.engine = engine
    free = policy(asked.clone())[keys.CHUNK]
    policy.start = RealtimeChunking()
    together = policy(asked.clone())[keys.CHUNK]
    torch.testing.assert_close(together[0], free[0], rtol=0, atol=1e-5)
    for row in range(5):
        alone = policy(asked[row : row + 1].clone())[keys.CHUNK][0]
        torch.testing.assert_close(alone, together[row], rtol=0, atol=1e-5)
    bare = policy(asked.exclude(keys.LAST_CHUNK, keys.ELAPSED, keys.DELAY))[keys.CHUNK]
    torch.testing.assert_close(bare, free, rtol=0, atol=1e-5)
    policy.start = None
    assert torch.equal(policy(asked.clone())[keys.CHUNK], free)
    assert keys.KNOWN not in policy.out_keys


class Asked(TensorDictModuleBase):
    """Keeps what it is handed, and takes as long as it is told."""

    in_keys, out_keys = [keys.LAST_CHUNK, keys.ELAPSED, keys.DELAY], [keys.CHUNK, keys.LATENCY]

    def __init__(self, seconds):
        super().__init__()
        self.seconds, self.handed = list(seconds), []

    def forward(self, td):
        self.handed.append((td[keys.ELAPSED].item(), td[keys.DELAY].item()))
        td[keys.CHUNK] = torch.zeros(*td.batch_size, 9, 1)
        return td.set(keys.LATENCY, torch.full((*td.batch_size, 1), self.seconds[len(self.handed) - 1]))


@pytest.mark.parametrize(
    ("latency", "delays"),
    [
        (0.1, [2, 2, 2, 2]),
        (0.0, [0, 0, 0, 0]),
        (None, [0, 1, 3, 2]),
    ],  # measured: that of the policy call before
)
def test_the_executor_says_how_late_the_answer_will_be(latency, delays):
    policy = Asked([0.05, 0.15, 0.1, 0.05])
    hold = TensorDictModule(lambda x: torch.zeros(1, 1), in_keys=[keys.IS_INIT], out_keys=[keys.HOLD])
    executor = RealtimeExecutor(policy, hold, 4, latency=latency)
    play(executor, 16)
    assert policy.handed == list(zip([0, 4, 4, 4], delays, strict=True))
    assert keys.DELAY not in executor.in_keys


def test_a_world_that_waits_has_no_delay():
    policy = Asked([0.05] * 2)
    play(ChunkExecutor(policy, 8), 16)
    assert policy.handed == [(0, 0), (8, 0)]


def play(executor, steps):
    td = TensorDict(batch_size=[1])
    for now in range(steps):
        td[keys.IS_INIT] = torch.tensor([[now == 0]])
        td = executor(td)


def test_it_is_not_saved_with_a_policy(policy, tmp_path):
    policy.start, policy.sampler = RealtimeChunking(), Sampler("ddpm", timesteps=[82, 14])
    assert policy.start.name == "rtc"
    with refused("start"):
        policy.save_pretrained(tmp_path / "policy")
