"""Late answers: what is played while the policy computes, and where a new chunk begins."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.collectors import Collector

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, keys, make_env
from torchrl_sparse.control.realtime_executor import HoldPose, RealtimeExecutor, delay_steps
from torchrl_sparse.envs.robosuite import RobosuiteEnv
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes

HOLDING = -7.0
HOLD = TensorDictModule(lambda now: torch.full_like(now, HOLDING), in_keys=["now"], out_keys=[keys.HOLD])


class ClockPolicy(TensorDictModuleBase):
    """Entry i of a chunk is the time for which it is meant, asked for at ``now``, plus 1000 * (that time it was asked)."""

    in_keys = ["now"]
    out_keys = [keys.CHUNK, keys.LATENCY]

    def __init__(self, length=9, latency=0.0):
        super().__init__()
        self.length, self.latency = length, latency

    def forward(self, td):
        meant_for = td["now"] + torch.arange(float(self.length))
        td[keys.CHUNK] = (meant_for + 1000 * td["now"])[..., None]
        return td.set(keys.LATENCY, torch.full_like(td["now"], self.latency))


def play(executor, steps, inits=(0,)):
    """Actions of one sample, as (time they were meant for, time they were asked for), or None for the hold."""
    td, actions = TensorDict(batch_size=[1]), []
    for now in range(steps):
        td["now"] = torch.full((1, 1), float(now))
        td[keys.IS_INIT] = torch.tensor([[now in inits]])
        td = executor(td)
        value = td[keys.ACTION].item()
        actions.append(None if value == HOLDING else (int(value % 1000), int(value // 1000)))
    return actions


def expected(delay, period, length, steps):
    """The same by simulating the two clocks: one of the world, one of the computer."""
    actions, playing, arriving, arrival, next_query = [], None, None, -1, 0
    for now in range(steps):
        if arriving is not None and now >= arrival:
            playing, arriving = arriving, None
        if now >= next_query and arriving is None:
            arriving, arrival, next_query = now, now + delay, now + period
            if delay == 0:
                playing, arriving = now, None
        actions.append(None if playing is None else (min(now, playing + length - 1), playing))
    return actions


@pytest.mark.parametrize("delay", [0, 1, 2, 3, 7, 8, 11, 25])
@pytest.mark.parametrize("period", [1, 3, 8])
def test_plays_what_two_clocks_say(delay, period):
    executor = RealtimeExecutor(ClockPolicy(), HOLD, period, latency=delay / 20)
    assert play(executor, 60) == expected(delay, period, 9, 60)


@pytest.mark.parametrize("delay", [0, 2, 5])
def test_no_query_comes_before_it_was_announced(delay):
    executor, td = RealtimeExecutor(ClockPolicy(), HOLD, 4, latency=delay / 20), TensorDict(batch_size=[1])
    until, queried = [], []
    for now in range(24):
        td["now"], td[keys.IS_INIT] = torch.full((1, 1), float(now)), torch.tensor([[now == 0]])
        td = executor(td)
        until.append(td[keys.UNTIL_QUERY].item())
        queried.append(td[keys.QUERIED].item())
    assert max(until) == 3
    assert sum(queried) > 3
    assert not any(any(queried[now + 1 : now + 1 + left]) for now, left in enumerate(until))


def test_a_measured_latency_is_that_of_each_query():
    policy = ClockPolicy(latency=0.12)
    executor = RealtimeExecutor(policy, HOLD, 4)
    assert play(executor, 20) == expected(3, 4, 9, 20)


def test_a_new_episode_holds_and_forgets_the_old_chunk():
    executor = RealtimeExecutor(ClockPolicy(), HOLD, 4, latency=0.1)
    actions = play(executor, 16, inits=(0, 5))
    assert actions[5:7] == [None, None]
    assert actions[7] == (7, 5)


def test_samples_of_a_batch_keep_their_own_clocks():
    executor = RealtimeExecutor(ClockPolicy(), HOLD, 4, latency=0.1)
    td, rows = TensorDict(batch_size=[2]), []
    for now in range(14):
        td["now"] = torch.full((2, 1), float(now))
        td[keys.IS_INIT] = torch.tensor([[now == 0], [now in (0, 5)]])
        td = executor(td)
        rows.append(td[keys.ACTION].flatten().tolist())
    alone = [play(executor, 14, inits) for inits in ((0,), (0, 5))]
    for row, actions in zip(zip(*rows, strict=True), alone, strict=True):
        assert list(row) == [HOLDING if a is None else a[0] + 1000 * a[1] for a in actions]


def test_a_gate_is_not_heard_while_an_answer_is_awaited():
    controller = TensorDictModule(lambda now: torch.ones_like(now, dtype=torch.bool), ["now"], [keys.REPLAN])
    executor = RealtimeExecutor(ClockPolicy(), HOLD, 8, latency=0.15, controller=controller)
    assert play(executor, 20) == expected(3, 1, 9, 20)


@pytest.mark.parametrize("latency", [-0.1, float("nan"), float("inf")])
def test_a_bad_latency_is_named(latency):
    with refused("latency"):
        RealtimeExecutor(ClockPolicy(), HOLD, latency=latency)


def test_rounding_errors_are_no_delay():
    steps = torch.arange(200)
    assert torch.equal(delay_steps(steps.float() / 20), steps)


def test_holding_leaves_the_arm_where_it_is():
    env = RobosuiteEnv("Lift", seeds=[3])
    td = env.reset()
    start = env.raw_observation()["robot0_eef_pos"]
    td[keys.ACTION] = HoldPose(find_robosuite_task("lift").pose_slices())(td.clone())[keys.HOLD]
    for _ in range(20):
        td = env.step(td)["next"].set(keys.ACTION, td[keys.ACTION])
    moved = env.raw_observation()["robot0_eef_pos"] - start
    env.close()
    assert np.linalg.norm(moved) < 1e-3


@pytest.fixture(scope="module")
def policy():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler = Sampler("ddim", 5)
    return policy


def test_without_latency_robosuite_sees_the_ordinary_evaluation(policy):
    hold, make = HoldPose(find_robosuite_task("lift").pose_slices()), partial(make_env, "Lift", horizon=40)

    def outcomes(actor):
        episodes = rollout_episodes(actor, make, [100_000], num_envs=1)
        return [replace(episode, latency=()) for episode in episodes]

    plain = outcomes(ChunkExecutor(policy))
    assert outcomes(RealtimeExecutor(policy, hold, latency=0.0)) == plain
    assert outcomes(RealtimeExecutor(policy, hold, latency=0.1)) != plain


def test_without_latency_every_action_is_the_ordinary_one(policy):
    td = TensorDict(
        {"history": {"state": torch.randn(3, 2, 19)}, "observation": {"state": torch.ones(3, 19)}}, [3]
    )
    td[keys.EPISODE_SEED] = torch.arange(3)[:, None]
    late = td.clone()
    executors = (
        ChunkExecutor(policy),
        RealtimeExecutor(policy, HoldPose(find_robosuite_task("lift").pose_slices()), latency=0.0),
    )
    for step in range(10):
        for each in (td, late):
            each[keys.EPISODE_STEP] = torch.full((3, 1), step)
            each[keys.IS_INIT] = torch.tensor([[step == 0], [step in (0, 5)], [step == 0]])
        actions = [actor(each)[keys.ACTION] for actor, each in zip(executors, (td, late), strict=True)]
        assert torch.equal(*actions)


def test_its_keys_pass_through_a_collector(policy):
    actor = RealtimeExecutor(policy, HoldPose(find_robosuite_task("lift").pose_slices()), latency=0.1)
    collector = Collector(
        make_env("Lift"),
        actor,
        frames_per_batch=12,
        total_frames=12,
        auto_register_policy_transforms=True,
    )
    batch = next(iter(collector))
    collector.shutdown()
    assert batch[keys.QUERIED].flatten().nonzero().flatten().tolist() == [0, 8]
    assert batch[keys.DELAY].eq(2).all()
    assert batch[keys.MEANWHILE].shape == (12, 9, 10)
