"""The design's collector line with a vision-language-action model and SpecPrune, on robosuite with two cameras."""

from functools import partial

import pytest
import torch
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs.utils import ExplorationType

from tests.tokens.helpers import LAYERS, PER_CAMERA, SIZE
from torchrl_sparse import ActionAwareController, ChunkExecutor, keys, make_env
from torchrl_sparse.control.action_aware import Thresholds
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.specprune import SpecPrune

HORIZON, FRAMES, N_ACTION_STEPS, WARMUP = 8, 10, 4, 6
ANY_MOTION = Thresholds(9.0, 99.0, leave_translation=9.0, leave_rotation=99.0, leave_rise=9.0)


OPTIONS = {"auto_register_policy_transforms": True, "exploration_type": ExplorationType.RANDOM}


def rendered(seed):
    return make_env(
        "Lift",
        seeds=[seed],
        horizon=HORIZON,
        action_mode="delta",
        camera="agentview",
        wrist_camera="robot0_eye_in_hand",
        image_size=SIZE,
        instruction=True,
    )


@pytest.fixture(scope="module")
def env():
    env = rendered(0)
    try:
        env.reset()
    except RuntimeError as error:  # no GL library
        pytest.skip(str(error))
    return env


def make_actor():
    torch.manual_seed(0)
    sizes = {"state_dim": 19, "chunk_size": N_ACTION_STEPS, "llm": TransformerSize(32, LAYERS, 2, 64)}
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(image_size=SIZE, **sizes)))
    policy.network.head.fc2.bias.data[2] = -2.0  # downwards
    policy.pruner = SpecPrune(alpha=0.1, dynamic=False)
    controller = ActionAwareController(thresholds=ANY_MOTION, warmup_steps=WARMUP)
    return ChunkExecutor(policy, n_action_steps=N_ACTION_STEPS, controller=controller)


def test_tokens_are_pruned_by_history_and_speed(env):
    actor = make_actor()
    steps = first_batch(Collector(env, actor, frames_per_batch=FRAMES, total_frames=FRAMES, **OPTIONS))
    assert not set(actor.out_keys) - set(steps.keys(True, True))
    check_episode(steps[:HORIZON])
    assert steps[keys.KEPT][HORIZON] == 2 * PER_CAMERA  # the next episode knows nothing either


@pytest.mark.usefixtures("env", "forked_workers")  # the first skips without a GL library
def test_processes_collect_the_same_episodes():
    workers, frames = [partial(rendered, seed) for seed in (0, 1)], 2 * HORIZON
    collector = MultiSyncCollector(
        workers, make_actor(), frames_per_batch=frames, total_frames=frames, cat_results="stack", **OPTIONS
    )
    batch = first_batch(collector).reshape(2, HORIZON)
    assert sorted(batch[keys.EPISODE_SEED][:, 0].flatten().tolist()) == [0, 1]
    for steps in batch:
        check_episode(steps)


def first_batch(collector):
    try:
        return next(iter(collector)).clone()
    finally:
        collector.shutdown()


def check_episode(steps):
    """Policy calls at 0 and 4, and at 6, where fine mode begins, in mid-chunk."""
    queries = steps[keys.QUERIED].squeeze(-1).nonzero().squeeze(-1).tolist()
    assert queries == [0, 4, 6]
    kept = steps[keys.KEPT].squeeze(-1)[queries]
    assert kept[0] == 2 * PER_CAMERA  # nothing is known yet
    assert (kept[1:] < 2 * PER_CAMERA).all()
    # Carried, changed, and those of two layers: four sets of 2 tokens of each camera, or of 4, which overlap.
    deepest = (steps[keys.TOKEN_DEPTH] == LAYERS).unflatten(-1, (2, -1)).sum(-1)[queries]
    coarse, fine = deepest[1], deepest[2]
    assert ((coarse >= 2) & (coarse <= 4 * 2)).all()
    assert ((fine >= 4) & (fine <= 4 * 4)).all()
    for step in range(len(steps)):
        last = max(query for query in queries if query <= step)
        for camera, key in enumerate((keys.IMAGE, keys.WRIST_IMAGE)):
            assert torch.equal(steps[keys.TOKEN_FRAMES][step, camera], steps[key][last])
