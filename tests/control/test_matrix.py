"""Every executor in every environment and collector: asked as often, and playing the same, as in one environment alone.

Episodes have different lengths, so that environments are reset one by one, and batches end within chunks.
"""

from functools import cache, partial

import pytest
import torch
from tensordict import lazy_stack
from torchrl.collectors import AsyncBatchedCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv

from tests.counting import (
    EXECUTORS,
    SEEDS,
    by_hand,
    expected_chunks,
    expected_ensemble,
    expected_realtime,
    make_count_env,
)
from torchrl_sparse import keys

MAKERS = [partial(make_count_env, seeds) for seeds in SEEDS]
BATCH, BATCHES = 22, 2  # 11 steps of each environment: no multiple of a chunk
BY_RULE = {"chunks": expected_chunks, "realtime": expected_realtime, "ensemble": expected_ensemble}
QUICK = ("chunks", "realtime", "tokens")
SENT = [  # through collectors that start processes for each of them, half a minute of a core in all
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EXECUTORS
]
ALIVE = []  # collectors, which close their environment as they are forgotten, even if told not to
COMPARED = [keys.EPISODE_SEED, keys.EPISODE_STEP, keys.ACTION, keys.QUERIED]
OPTIONS = {"frames_per_batch": BATCH, "auto_register_policy_transforms": True}


@cache
def alone(name):
    """What each step plays, (action, asked), and whether it does, by (seed, step)."""
    play = partial(by_hand, EXECUTORS[name]())
    return {(seed, t): step for seeds in SEEDS for seed in seeds for t, step in enumerate(play(seed))}


def check(name, steps):
    """Compare collected steps with those of one environment alone; all environments are there."""
    steps = steps.reshape(-1)
    places = torch.cat([steps[keys.EPISODE_SEED], steps[keys.EPISODE_STEP]], -1).tolist()
    played, asked = steps[keys.ACTION].flatten().tolist(), steps[keys.QUERIED].flatten().tolist()
    expected = [alone(name)[seed, step] for seed, step in places]
    assert played == pytest.approx([action for action, _ in expected], abs=1e-3)
    assert asked == [whether for _, whether in expected]
    return {seed for seed, _ in places}


def collect(name, collector, *, in_step=True, **shutdown):
    """Collect some batches and compare them; environments that do not step together may come in any number."""
    ALIVE.append(collector)
    try:
        batches = [data.clone() for _, data in zip(range(BATCHES), collector, strict=False)]
    finally:
        collector.shutdown(**shutdown)
    seen = check(name, torch.cat([batch.reshape(-1).select(*COMPARED) for batch in batches]))
    assert seen == {0, 1, 2, 3} if in_step else seen


@pytest.mark.parametrize("name", BY_RULE)
def test_one_environment_alone_plays_what_the_rule_says(name):
    actor = EXECUTORS[name]()
    for seeds in SEEDS:
        for seed in seeds:
            assert by_hand(actor, seed) == BY_RULE[name](seed)


@pytest.fixture(scope="module", params=["serial", "parallel", "parallel without buffers"])
def env(request):
    make = {
        "serial": SerialEnv,
        "parallel": partial(ParallelEnv, mp_start_method="fork"),
        "parallel without buffers": partial(ParallelEnv, use_buffers=False, mp_start_method="fork"),
    }
    env = make[request.param](2, MAKERS)
    yield env
    if not env.is_closed:
        env.close()


@pytest.mark.parametrize("name", EXECUTORS)
def test_collector_of_a_batch_of_environments(env, name):
    collect(name, Collector(env, EXECUTORS[name](), total_frames=-1, **OPTIONS), close_env=False)


@pytest.mark.parametrize("name", EXECUTORS)
def test_rollout(env, name):
    actor = EXECUTORS[name]()
    primed = TransformedEnv(env, actor.make_tensordict_primer())
    ALIVE.append(primed)
    steps = primed.rollout(BATCH, actor, break_when_any_done=False)
    assert check(name, steps) == {0, 1, 2, 3}


@pytest.mark.parametrize("name", EXECUTORS)
def test_async_batched_collector(name):
    options = {"frames_per_batch": BATCH, "transport": "driver", "env_backend": "threading"}
    collector = AsyncBatchedCollector(MAKERS, policy=EXECUTORS[name](), total_frames=-1, **options)
    collect(name, collector, in_step=False)


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("name", EXECUTORS)
def test_rows_that_an_asynchronous_collector_stacks(name, together):
    actor, steps = EXECUTORS[name](), []
    envs = [make_count_env(seeds) for seeds in SEEDS]
    rows = [env.reset() for env in envs]
    for turn in range(BATCH):
        served = [0, 1] if together and turn > 2 else [0] if turn < 3 else [turn % 2]
        answers = actor(lazy_stack([rows[i] for i in served]))
        for i, answer in zip(served, answers.unbind(0), strict=True):
            step, rows[i] = envs[i].step_and_maybe_reset(answer)
            steps.append(step.select(*COMPARED))
    assert check(name, torch.stack(steps)) == {0, 1, 2, 3}


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("kind", [MultiSyncCollector, MultiAsyncCollector])
@pytest.mark.parametrize("name", SENT)
def test_collectors_of_processes(kind, name):
    collector = kind(MAKERS, EXECUTORS[name](), total_frames=-1, **OPTIONS)
    collect(name, collector, in_step=kind is MultiSyncCollector)


@pytest.mark.usefixtures("ray_cluster")  # skips without Ray
@pytest.mark.parametrize("name", SENT)
def test_ray_collector(name):
    from torchrl.collectors.distributed import RayCollector

    collector = RayCollector(
        MAKERS,
        EXECUTORS[name](),
        frames_per_batch=BATCH,
        total_frames=2 * BATCHES * BATCH,
        sync=True,
        remote_configs={"num_cpus": 1},
        collector_kwargs={"auto_register_policy_transforms": True},
    )
    collect(name, collector)


def primed_env(actor, chunk_shape, seeds):
    return TransformedEnv(make_count_env(seeds), actor.make_tensordict_primer(chunk_shape))


@pytest.mark.parametrize("name", ["realtime", "tokens"])
def test_primers_within_the_environments(name):
    actor, shape = EXECUTORS[name](), (8, 1) if name == "realtime" else None
    env = ParallelEnv(
        2, [partial(primed_env, actor, shape, seeds) for seeds in SEEDS], mp_start_method="fork"
    )
    collect(name, Collector(env, actor, total_frames=-1, **OPTIONS))


@pytest.mark.parametrize("name", EXECUTORS)
def test_specs_are_those_of_what_is_written(name):
    actor, env = EXECUTORS[name](), make_count_env([0])
    chunk = actor.policy(env.reset().unsqueeze(0))[keys.CHUNK]
    primer = actor.make_tensordict_primer(tuple(chunk.shape[1:]))
    steps = env.rollout(7, actor)
    undeclared = set(actor._carried_keys()) - set(primer.primers.keys(True, True))
    assert not undeclared
    for key, spec in primer.primers.items(True, True):
        assert (steps[key].shape[1:], steps[key].dtype) == (spec.shape, spec.dtype), key
