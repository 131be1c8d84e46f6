"""A VLA without an executor, whose whole chunks TorchRL's `MultiAction` plays: what its pruner carries is carried there too."""

from functools import partial

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import MultiAction, ParallelEnv, TransformedEnv

from tests.counting import make_count_env, vision_policy
from torchrl_sparse import keys
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner

SEEDS = ((0, 2), (1, 3))
QUERIES = 5


def make_policy():
    return vision_policy(FrameDifferencePruner(0.5))


def make_env():
    """In two processes, which hand back the keys of their spec alone."""
    env = ParallelEnv(2, [partial(make_count_env, seeds) for seeds in SEEDS], mp_start_method="fork")
    return TransformedEnv(env, MultiAction.from_vla(stack_rewards=False))


@pytest.fixture(scope="module")
def alone():
    """What each policy call of one environment alone keeps, by seed and step."""
    kept = {}
    policy = make_policy()
    for seeds in SEEDS:
        env = TransformedEnv(make_count_env(seeds), MultiAction.from_vla(stack_rewards=False))
        steps = env.rollout(QUERIES, lambda td: policy(td[None])[0], break_when_any_done=False)
        kept |= by_place(steps)
    return kept


def by_place(steps):
    steps = steps.reshape(-1)
    places = torch.cat([steps[keys.EPISODE_SEED], steps[keys.EPISODE_STEP]], -1).tolist()
    return dict(zip(map(tuple, places), steps[keys.KEEP_MASK].tolist(), strict=True))


def test_a_pruner_compares_with_the_last_query(alone):
    """The first call of an episode keeps every token, later ones those that changed: without the last images all would."""
    collector = Collector(make_env(), make_policy(), frames_per_batch=2 * QUERIES, total_frames=2 * QUERIES)
    try:
        (steps,) = list(collector)
    finally:
        collector.shutdown()
    assert by_place(steps) == alone
    assert any(not all(mask) for mask in alone.values())
