"""State that a policy carries in keys follows it through batched environments, or its loss is noticed."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import step_mdp

from tests.counting import EXECUTORS, SEEDS, counting_policy, make_count_env
from tests.refusals import refused
from torchrl_sparse import ActionAwareController, ChunkExecutor, keys
from torchrl_sparse.carried import dense

ALIVE = []  # collectors, which close their environment as they are forgotten, even if told not to
DROPPED = (
    r"\('control', '{}'\): expected what the step before left.*none in {} of 2 rows.*make_tensordict_primer"
)


@pytest.fixture(scope="module")
def env():
    env = ParallelEnv(2, [partial(make_count_env, seeds) for seeds in SEEDS], mp_start_method="fork")
    yield env
    env.close()


def test_the_ordinary_way_to_collect_plays_whole_chunks(env):
    """Right: one policy call in four steps, as in a `SerialEnv` (pytorch/rl#1406, #2327, #2362)."""
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
    with refused("('control', 'age')"):
        env.rollout(3, ChunkExecutor(counting_policy(4), 4), break_when_any_done=False)


def test_zeros_in_the_place_of_the_state_are_an_error():
    """Right: as if nothing was there; shared buffers that nobody writes to hold zeros."""
    env, actor = make_count_env([0]), ChunkExecutor(counting_policy(4), 4)
    td = step_mdp(env.step(actor(env.reset())))
    for key in (keys.AGE, keys.QUERIED, keys.CHUNK):
        td[key] = torch.zeros_like(td[key])
    with refused("('control', 'age')"):
        actor(td)


def test_what_a_controller_carries_is_missed_too():
    """Right: mode and warm-up of a controller whose keys are dropped would start again at every step."""
    env = make_count_env([0])
    actor = ChunkExecutor(counting_policy(4), 4, ActionAwareController())
    td = step_mdp(env.step(actor(env.reset()))).exclude(keys.FINE)
    with refused("('control', 'fine')"):
        actor(td)


@pytest.mark.parametrize("name", ["chunks", "realtime", "tokens"])
def test_an_actor_that_takes_over_in_mid_episode_asks_at_once(name):
    """Right: no step of its own was before, so nothing is lost (`init_random_frames` of TorchRL's collectors)."""
    env, actor = make_count_env([2]), EXECUTORS[name]()
    options = {"frames_per_batch": 7, "total_frames": 14, "auto_register_policy_transforms": True}
    collector = Collector(env, actor, init_random_frames=7, **options)
    _, steps = (data.clone() for data in collector)
    collector.shutdown()
    assert steps[keys.EPISODE_STEP].flatten()[0] == 7
    assert steps[keys.QUERIED].flatten()[0]
    if name == "chunks":
        assert steps[keys.ACTION].flatten().tolist() == [70, 71, 72, 0, 1, 2, 3]
    if name == "realtime":  # holds until its first answer is there
        assert steps[keys.ACTION].flatten().tolist() == [-3, -3, 72, -3, -3, 2, 3]


def test_a_loop_that_keeps_the_specs_keys_alone_keeps_the_state():
    """Right: what is in the spec is in ``("next", ...)``; without a primer it is gone, which is an error."""
    actor = ChunkExecutor(counting_policy(4), 4)
    bare, primed = make_count_env([0]), make_count_env([0])
    primed.append_transform(actor.make_tensordict_primer((4, 1)))
    td, played = primed.reset(), []
    for _ in range(6):
        td = primed.step(actor(td))
        played.append(td[keys.ACTION].item())
        td = step_mdp(td, keep_other=False)
    assert played == [0, 1, 2, 3, 40, 41]
    with refused("('control', 'age')"):
        actor(step_mdp(bare.step(actor(bare.reset())), keep_other=False))


def test_rows_that_disagree_about_what_they_have_are_refused():
    """tensordict: a lazy stack shows the keys of all rows alone; one that a policy reads must not vanish."""
    first = TensorDict({"state": torch.zeros(2), "budget": torch.ones(1)})
    module = TensorDictModule(torch.neg, in_keys=["memory"], out_keys=["memory"])
    second = TensorDict({"state": torch.ones(2), "memory": torch.ones(1)})
    with pytest.raises(KeyError, match="'budget' in all of 2 rows or in none"):
        dense(lazy_stack([first, second]), module)
    whole = dense(lazy_stack([first.exclude("budget"), second]), module)
    assert whole["memory"].tolist() == [[0.0], [1.0]]
