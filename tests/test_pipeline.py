"""The four lines of the README, in every collector of TorchRL, on a real robosuite task."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from torchrl.collectors import AsyncBatchedCollector, Collector, Evaluator, MultiSyncCollector
from torchrl.envs import SerialEnv
from torchrl.envs.utils import ExplorationType

from torchrl_sparse import (
    ChunkExecutor,
    DiffusionPolicy,
    Normalizer,
    Planner,
    Sampler,
    TransformerForDiffusion,
    keys,
    make_env,
)
from torchrl_sparse.blocks.mask import prune_rate, query_flops

N_ACTION_STEPS = 4
HORIZON = 10


class FarMeansCareful(Planner):
    """A planner of one's own: the further the hand is from the cube, the less is computed."""

    def masks(self, cond):
        distance = cond[:, -1, 7:10].norm(dim=-1)
        interval = 2 + (distance > 0.1).long()
        step = torch.arange(self.spec.num_inference_steps)
        pruned = step[None] % interval[:, None] != 0
        return pruned[..., None].expand(-1, -1, self.spec.num_blocks)


def small_policy():
    torch.manual_seed(0)
    sizes = {"input_dim": 10, "output_dim": 10, "horizon": 6, "n_obs_steps": 2, "cond_dim": 19}
    network = TransformerForDiffusion(**sizes, n_layer=2, n_head=2, n_emb=16)
    scale, offset = torch.ones(10), torch.zeros(10)
    # Poses the arm can reach: half a metre in front of the base, gripper down.
    scale[:3], offset[:3] = 20.0, -20.0 * torch.tensor([0.0, 0.0, 1.0])
    offset[3:9] = -torch.tensor([0.0, 1, 0, 1, 0, 0])
    normalizer = Normalizer(torch.ones(19), torch.zeros(19), scale, offset)
    policy = DiffusionPolicy(network, normalizer, sampler=Sampler("ddpm", 6))
    policy.plan = FarMeansCareful()
    return policy


def actor():
    return ChunkExecutor(small_policy(), n_action_steps=N_ACTION_STEPS)


def env(seed):
    return make_env("Lift", seeds=[seed], horizon=HORIZON)


def alone(seed, frames):
    """The same episode without any collector."""
    return env(seed).rollout(frames, actor(), auto_cast_to_device=True)


def check(steps, seed):
    """One environment's first episode [T <= HORIZON], from whatever collected it."""
    queried = steps[keys.QUERIED].squeeze(-1)
    assert queried.tolist() == [step % N_ACTION_STEPS == 0 for step in range(len(steps))]
    assert torch.equal(prune_rate(steps[keys.PRUNE_MASK]) > 0, torch.ones(len(steps), dtype=torch.bool))
    flops = query_flops(small_policy().network, steps[keys.PRUNE_MASK])
    torch.testing.assert_close(steps[keys.FLOPS].squeeze(-1), torch.where(queried, flops, 0.0))
    assert ((steps[keys.LATENCY] > 0).squeeze(-1) == queried).all()
    reference = alone(seed, len(steps))
    torch.testing.assert_close(steps[keys.CHUNK][0], reference[keys.CHUNK][0], atol=1e-5, rtol=0)
    torch.testing.assert_close(steps["action"], reference["action"], atol=1e-3, rtol=0)
    missing = set(actor().out_keys) - set(steps.keys(True, True))
    assert not missing


OPTIONS = {"total_frames": 16, "frames_per_batch": 16, "exploration_type": ExplorationType.RANDOM}


def first_batch(collector):
    try:
        return next(iter(collector)).clone()
    finally:
        collector.shutdown()


def test_collector_of_one_environment():
    batch = first_batch(Collector(env(3), actor(), auto_register_policy_transforms=True, **OPTIONS))
    check(batch[:HORIZON], 3)
    assert batch[keys.AGE].squeeze(-1)[HORIZON] == 0  # the next episode starts with a policy call


def test_collector_of_a_batch_of_environments():
    batched = SerialEnv(2, [partial(env, 3), partial(env, 4)])
    batch = first_batch(Collector(batched, actor(), auto_register_policy_transforms=True, **OPTIONS))
    for row, seed in enumerate((3, 4)):
        check(batch[row], seed)


@pytest.mark.usefixtures("forked_workers")
def test_multi_sync_collector():
    collector = MultiSyncCollector(
        [partial(env, 3), partial(env, 4)],
        actor(),
        cat_results="stack",
        auto_register_policy_transforms=True,
        **OPTIONS,
    )
    batch = first_batch(collector)
    for steps in batch.reshape(-1, 8):
        check(steps, int(steps[keys.EPISODE_SEED][0]))


def test_async_batched_collector():
    collector = AsyncBatchedCollector(
        [partial(env, 3), partial(env, 4)],
        policy=actor(),
        frames_per_batch=16,
        total_frames=16,
        exploration_type=ExplorationType.RANDOM,
        transport="driver",
        env_backend="threading",
    )
    steps = first_batch(collector).reshape(-1)
    for seed in (3, 4):
        mine = steps[steps[keys.EPISODE_SEED].squeeze(-1) == seed]
        order = mine[keys.EPISODE_STEP].squeeze(-1)
        assert order[: min(len(order), HORIZON)].tolist() == list(range(min(len(order), HORIZON)))
        check(mine[:HORIZON], seed)


def test_evaluator():
    seen = []

    def metrics(trajectories):
        seen.append(trajectories)
        return {"queries": float(trajectories[keys.QUERIED].sum())}

    evaluator = Evaluator(
        env(3),
        actor(),
        num_trajectories=1,
        max_steps=HORIZON,
        exploration_type=ExplorationType.RANDOM,
        metrics_fn=metrics,
        collector_kwargs={"traj_format": "cat"},
    )
    try:
        result = evaluator.evaluate(step=0)
    finally:
        evaluator.shutdown()
    assert result["eval/queries"] == 3  # steps 0, 4 and 8
    check(seen[0].reshape(-1)[:HORIZON], 3)


def test_samples_at_their_first_step_may_be_stacked_with_others():
    executor = actor()
    here, there = env(3).reset(), env(4).reset()
    started = executor(here.clone())
    expected = started[keys.CHUNK].clone()
    later = started.exclude("action")
    later["is_init"] = torch.zeros(1, dtype=torch.bool)
    stacked = executor(lazy_stack([later, there]))
    assert stacked[keys.QUERIED].squeeze(-1).tolist() == [False, True]
    assert stacked[keys.AGE].squeeze(-1).tolist() == [1, 0]
    assert torch.equal(stacked[keys.CHUNK][0], expected)


def test_noise_follows_the_episode_and_nothing_else():
    policy = small_policy()
    request = TensorDict({keys.HISTORY_STATE: torch.zeros(3, 2, 19)}, [3])
    request[keys.EPISODE_SEED] = torch.tensor([[1], [2], [1]])
    request[keys.EPISODE_STEP] = torch.tensor([[0], [0], [8]])
    chunks = policy(request.clone())[keys.CHUNK]
    assert not torch.allclose(chunks[0], chunks[1])
    assert not torch.allclose(chunks[0], chunks[2])
    torch.manual_seed(123)
    assert torch.equal(policy(request.clone())[keys.CHUNK], chunks)
    del request["episode"]
    assert not torch.equal(policy(request.clone())[keys.CHUNK], chunks)


@pytest.mark.parametrize("batch", [(), (1,), (2, 2)])
def test_policy_takes_any_batch(batch):
    td = small_policy()(TensorDict({keys.HISTORY_STATE: torch.zeros(*batch, 2, 19)}, batch))
    assert td[keys.CHUNK].shape == (*batch, 5, 10)
    assert td[keys.PRUNE_MASK].shape == (*batch, 6, 6)
    assert td[keys.FLOPS].shape == td[keys.LATENCY].shape == (*batch, 1)
