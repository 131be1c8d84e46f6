"""The pipeline as a whole: equalities with the network by hand, swapping planners and samplers, bad input."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import (
    BAC,
    CacheSchedule,
    Dense,
    DiffusionPolicy,
    SAGPruner,
    Sampler,
    SchedulePlanner,
    Uniform,
    keys,
)
from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import calibrate
from torchrl_sparse.blocks.mask import query_flops
from torchrl_sparse.blocks.planner import Planner
from torchrl_sparse.networks.diffusion.noise import query_seed, sample_noise


def request(*batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    td = TensorDict({keys.HISTORY_STATE: torch.randn(*batch, 2, 5, generator=generator)}, batch)
    td[keys.EPISODE_SEED] = torch.arange(td.batch_size.numel()).reshape(*batch, 1)
    td[keys.EPISODE_STEP] = torch.zeros(*batch, 1, dtype=torch.int64)
    return td


def test_dense_chunk_is_the_textbook_loop(policy):
    policy.engine = "reference"
    td = policy(request(3))
    cond = policy.normalizer.normalize_state(request(3)[keys.HISTORY_STATE])
    noise = policy.sample_noise(td[keys.SEED].squeeze(-1))
    sample = noise[:, 0]
    with torch.no_grad():
        for step, timestep in enumerate(policy.sampler.timesteps):
            eps = policy.network(sample, timestep, cond)
            following = noise[:, step + 1] if step + 1 < policy.num_inference_steps else None
            sample = policy.sampler.step(eps, step, sample, following)
    assert torch.equal(td[keys.CHUNK], policy.normalizer.unnormalize_action(sample)[:, 1:])


@pytest.mark.parametrize("plan", ["all updates", "interval of one"])
def test_plans_that_prune_nothing_are_bit_exactly_dense(policy, plan):
    dense = policy(request(2))[keys.CHUNK]
    if plan == "all updates":
        noise, cond = policy.sample_noise(torch.tensor([1])), torch.zeros(1, 2, 5)
        calibration = calibrate(policy.network, policy.sampler, noise, cond)
        schedule = bac_schedule(calibration, policy.num_inference_steps, policy=policy.fingerprint)
        policy.plan = BAC(schedule)
    else:
        policy.plan = Uniform(1)
    assert torch.equal(policy(request(2))[keys.CHUNK], dense)


def test_no_plan_is_dense(policy):
    dense = policy(request(2))[keys.CHUNK]
    policy.plan = Uniform(4)
    assert not torch.equal(policy(request(2))[keys.CHUNK], dense)
    policy.plan = None
    assert isinstance(policy.plan, Dense)
    assert torch.equal(policy(request(2))[keys.CHUNK], dense)


def test_another_plan_leaves_the_policy_as_it_is(policy):
    other = policy.with_plan(Uniform(2), Sampler("ddim", 4))
    assert other.network is policy.network
    assert (other.num_inference_steps, other.plan.interval) == (4, 2)
    assert policy.num_inference_steps == 8
    assert isinstance(policy.plan, Dense)


def test_rows_with_different_masks_equal_the_rows_alone(policy):
    class Alternate(Planner):
        def masks(self, cond):
            mask = torch.zeros(
                len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool
            )
            mask[cond[:, 0, 0] > 0, 1::2] = True
            return mask

    policy.plan = Alternate()
    together = policy(request(6))
    assert together[keys.PRUNE_MASK].flatten(1).any(1).unique().numel() == 2
    for row in range(6):
        alone = policy(request(6)[row])
        torch.testing.assert_close(alone[keys.CHUNK], together[keys.CHUNK][row], atol=1e-6, rtol=0)
        assert torch.equal(alone[keys.FLOPS], together[keys.FLOPS][row])


def test_flops_follow_the_mask_and_latency_is_measured(policy):
    dense = policy(request(1))
    policy.plan = Uniform(4)
    sparse = policy(request(1))
    assert 0 < sparse[keys.FLOPS].item() < dense[keys.FLOPS].item()
    assert sparse[keys.LATENCY].item() > 0


def test_flops_are_those_of_the_loop_and_of_a_planner_that_looks():
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.plan = SAGPruner.from_pretrained("assets/lift/sag")
    td = policy(TensorDict({keys.HISTORY_STATE: torch.zeros(2, 2, 19)}, [2]))
    of_loop = query_flops(policy.network, td[keys.PRUNE_MASK])
    assert td[keys.FLOPS].squeeze(-1).tolist() == (of_loop + 2 * policy.plan.network.macs_per_query).tolist()
    policy.plan = None
    td = policy(TensorDict({keys.HISTORY_STATE: torch.zeros(2, 2, 19)}, [2]))
    assert td[keys.FLOPS].squeeze(-1).tolist() == query_flops(policy.network, td[keys.PRUNE_MASK]).tolist()


def test_changing_the_sampler_rebinds_the_plan(policy):
    policy.plan = Uniform(2)
    policy.sampler = Sampler("ddim", 4)
    td = policy(request(2))
    assert td[keys.PRUNE_MASK].shape == (2, 4, policy.num_blocks)
    assert policy.num_inference_steps == 4


def test_a_plan_that_does_not_fit_leaves_the_policy_as_it_was(policy):
    steps = tuple((0, 3) for _ in range(policy.num_blocks))
    layers = policy.network.n_layer
    policy.plan = SchedulePlanner(CacheSchedule("mine", policy.fingerprint, 8, layers, steps))
    before = policy(request(1))[keys.CHUNK]
    with refused("SchedulePlanner"):
        policy.sampler = Sampler("ddim", 4)
    with refused("SchedulePlanner"):
        policy.plan = SchedulePlanner(CacheSchedule("mine", "another", 8, layers, steps))
    with refused("plan"):
        policy.plan = "bac"
    with refused("sampler"):
        policy.sampler = Sampler
    assert policy.num_inference_steps == 8
    assert torch.equal(policy(request(1))[keys.CHUNK], before)
    policy.plan = None
    policy.sampler = Sampler("ddim", 4)
    assert policy.num_inference_steps == 4


def test_keys_are_declared(policy):
    td = policy(request(2))
    assert set(policy.out_keys) == set(td.keys(True, True)) - set(policy.in_keys)
    assert isinstance(policy.plan, Dense)


def test_bad_observations_are_named(policy):
    with refused("('history', 'state')"):
        policy(TensorDict({keys.HISTORY_STATE: torch.zeros(3, 2, 6)}, [3]))
    with pytest.raises(KeyError, match=r"expected the key \('history', 'state'\), got .*other"):
        policy(TensorDict({"other": torch.zeros(3, 1)}, [3]))
    td = request(3)
    td[keys.HISTORY_STATE][1, 0, 2] = float("nan")
    with refused("('history', 'state')"):
        policy(td)


def test_query_seeds_do_not_collide():
    episode, step = torch.meshgrid(torch.arange(100_000, 100_200), torch.arange(100), indexing="ij")
    seeds = query_seed(episode, step)
    assert (seeds >= 0).all()
    # torch's CPU generator reads the low 32 bits only.
    assert (seeds & 0xFFFFFFFF).unique().numel() == seeds.numel()


def test_initial_noise_is_the_same_for_every_number_of_steps():
    seed = torch.tensor([3, 4])
    long, short = sample_noise(seed, 100, (10, 10)), sample_noise(seed, 1, (10, 10))
    assert torch.equal(long[:, :1], short)
    assert torch.equal(long[1], sample_noise(seed[1:], 100, (10, 10))[0])
    assert abs(long.mean()) < 0.02
    assert abs(long.std() - 1) < 0.02


def test_fingerprint_names_the_weights(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    assert DiffusionPolicy.from_pretrained(tmp_path).fingerprint == policy.fingerprint
    with torch.no_grad():
        policy.network.head.bias[0] += 1
    assert DiffusionPolicy.from_pretrained(tmp_path).fingerprint != policy.fingerprint
