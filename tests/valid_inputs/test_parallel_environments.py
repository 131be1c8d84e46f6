"""State that a policy carries in keys follows it through batched environments, or its loss is noticed."""

from functools import partial

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, TransformedEnv
from torchrl.envs.utils import step_mdp

from tests.counting import SEEDS, counting_policy, make_count_env
from torchrl_sparse import ActionAwareController, ChunkExecutor, keys

ALIVE = []  # collectors, which close their environment as they are forgotten, also when they were told not to
DROPPED = (
    r"\('control', '{}'\): expected what the step before left.*none in {} of 2 rows.*make_tensordict_primer"
)


@pytest.fixture(scope="module")
def env():
    env = ParallelEnv(2, [partial(make_count_env, seeds) for seeds in SEEDS], mp_start_method="fork")
    yield env
    env.close()


def test_the_ordinary_way_to_collect_plays_whole_chunks(env):
    """Right: one query in four steps, as in a `SerialEnv` (pytorch/rl#1406, #2327, #2362)."""
    actor = ChunkExecutor(counting_policy(4), 4)
    options = {"frames_per_batch": 8, "total_frames": 8, "auto_register_policy_transforms": True}
    collector = Collector(env, actor, **options)
    steps = next(iter(collector)).clone()
    collector.shutdown(close_env=False)
    ALIVE.append(collector)
    assert steps[keys.ACTION][..., 0].tolist() == [[0, 1, 2, 3]] * 2
    assert steps[keys.QUERIED].sum() == 2


def test_an_environment_that_drops_the_state_is_an_error(env):
    """Right: an error that says what to add; `is_init` False without an age is never right."""
    with pytest.raises(ValueError, match=DROPPED.format("age", 2)):
        env.rollout(3, ChunkExecutor(counting_policy(4), 4), break_when_any_done=False)


def test_zeros_in_the_place_of_the_state_are_an_error():
    """Right: as if nothing was there; shared buffers that nobody writes to hold zeros."""
    env, actor = make_count_env([0]), ChunkExecutor(counting_policy(4), 4)
    td = step_mdp(env.step(actor(env.reset())))
    for key in (keys.AGE, keys.QUERIED, keys.CHUNK):
        td[key] = torch.zeros_like(td[key])
    with pytest.raises(ValueError, match=r"\('control', 'age'\).* 1 of 1 rows"):
        actor(td)


def test_what_a_controller_carries_is_missed_too():
    """Right: mode and warm-up of a controller whose keys are dropped would start anew at every step."""
    env = make_count_env([0])
    actor = ChunkExecutor(counting_policy(4), 4, ActionAwareController())
    td = step_mdp(env.step(actor(env.reset()))).exclude(keys.FINE)
    with pytest.raises(ValueError, match=r"\('control', 'fine'\).* 1 of 1 rows"):
        actor(td)


def test_rows_that_begin_need_nothing(env):
    """Right: an episode begins without state, whatever the other rows have."""
    actor = ChunkExecutor(counting_policy(4), 4)
    primed = TransformedEnv(env, actor.make_tensordict_primer())
    begun = actor(primed.reset())
    assert begun[keys.QUERIED].all()
    assert begun[keys.AGE].eq(0).all()
