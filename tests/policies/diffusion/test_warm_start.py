"""Warm starts: what a policy call begins from, per sample and per episode, in every engine, against steps written out."""

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler, keys
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.planner import StaticPlanner
from torchrl_sparse.networks.diffusion.noise import sample_noise
from torchrl_sparse.policies.diffusion.warm_start import QueryStart, WarmStart, shift_chunk

ENGINES = ["reference", "torch", *(["native"] if native_available()[0] else [])]
SAMPLERS = ["ddpm8", "ddpm_82_41_14", "ddim10_eta0.5", "unipc10", "sde2m5"]


@pytest.fixture
def asked():
    """Five queries: at the beginning of an episode, and 1, 2, 4 and 9 steps after the policy call before."""
    generator = torch.Generator().manual_seed(0)
    query = {
        keys.HISTORY_STATE: torch.randn(5, 2, 5, generator=generator),
        keys.EPISODE_SEED: torch.arange(5)[:, None],
        keys.EPISODE_STEP: torch.arange(5)[:, None],
        keys.LAST_CHUNK: torch.rand(5, 5, 4, generator=generator) - 0.5,
        keys.ELAPSED: torch.tensor([[0], [1], [2], [4], [9]]),
    }
    return TensorDict(query, [5])


class Half(StaticPlanner):
    """Prunes every second block after the first step."""

    def mask(self, spec):
        mask = torch.zeros(spec.num_inference_steps, spec.num_blocks, dtype=torch.bool)
        mask[1:, ::2] = True
        return mask


def slow_answer(policy, query, num_steps):
    """The chunk of one policy call [], step by step through the network alone, nothing pruned."""
    network, normalizer, sampler = policy.network, policy.normalizer, policy.sampler
    cond = normalizer.normalize_state(query[keys.HISTORY_STATE])[None]
    noise = sample_noise(query[keys.SEED], sampler.num_inference_steps, (network.horizon, network.input_dim))
    sample, first, elapsed = noise[:, 0], 0, int(query[keys.ELAPSED])
    if elapsed:
        first = sampler.num_inference_steps - num_steps
        chunk, rows = query[keys.LAST_CHUNK], []
        for action in range(
            network.horizon
        ):  # of which the first belongs to the observation before the present one
            rows.append(chunk[min(max(elapsed + action - 1, 0), len(chunk) - 1)])
        guess = normalizer.normalize_action(torch.stack(rows))[None]
        abar = sampler.alphas_cumprod[sampler.timesteps[first]]
        sample = abar.sqrt() * guess + (1 - abar).sqrt() * sample
    part, cleans = Sampler(sampler.kind, timesteps=sampler.timesteps[first:].tolist(), eta=sampler.eta), ()
    part = sampler if first == 0 else part
    for k, timestep in enumerate(part.timesteps.tolist()):
        eps, before = network(sample, timestep, cond), sample
        gaussian = noise[:, k + 1] if k + 1 < part.num_inference_steps else None
        sample = part.step(eps, k, before, gaussian, cleans)
        cleans = part.remember(cleans, eps, k, before)
    return normalizer.unnormalize_action(sample[0, network.n_obs_steps - 1 :])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", SAMPLERS)
def test_every_engine_begins_where_the_slow_loop_does(policy, asked, engine, name):
    policy.engine, policy.sampler = engine, Sampler.from_name(name)
    policy.start = WarmStart(2)
    with torch.no_grad():
        answered = policy(asked.clone())
        for row in answered.unbind(0):
            torch.testing.assert_close(row[keys.CHUNK], slow_answer(policy, row, 2), rtol=0, atol=2e-5)
    assert answered[keys.NUM_STEPS].flatten().tolist() == [policy.num_inference_steps, 2, 2, 2, 2]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_row_of_a_batch_is_the_row_alone_also_where_blocks_are_pruned(policy, asked, engine):
    policy.engine, policy.plan, policy.start = engine, Half(), WarmStart(3)
    with torch.no_grad():
        together = policy(asked.clone())
        for row, query in zip(together.unbind(0), asked.unbind(0), strict=True):
            alone = policy(query[None].clone())[0]
            torch.testing.assert_close(alone[keys.CHUNK], row[keys.CHUNK], rtol=0, atol=1e-5)
            assert alone[keys.FLOPS] == row[keys.FLOPS]


def test_flops_are_of_the_steps_that_were_taken(policy, asked):
    policy.sampler = Sampler("ddpm", 8)
    whole = policy(asked.clone())[keys.FLOPS]
    policy.start = WarmStart(2)
    flops = policy(asked.clone())[keys.FLOPS]
    assert flops[0] == whole[0]
    torch.testing.assert_close(flops[1:], whole[1:] / 4)


def test_without_a_last_chunk_a_query_begins_from_noise(policy, asked):
    cold = policy(asked.clone())
    policy.start = WarmStart(2)
    bare = policy(asked.exclude(keys.LAST_CHUNK, keys.ELAPSED))
    assert torch.equal(bare[keys.CHUNK], cold[keys.CHUNK])
    policy.start = None
    assert torch.equal(policy(asked.clone())[keys.CHUNK], cold[keys.CHUNK])
    assert keys.NUM_STEPS not in policy.out_keys


def test_new_weights_are_seen_by_warm_queries_too(policy, asked):
    policy.engine, policy.start = "auto", WarmStart(2)
    before = policy(asked.clone())[keys.CHUNK]
    with torch.no_grad():
        policy.network.head.weight.mul_(1.5)
    after = policy(asked.clone())
    assert not torch.equal(after[keys.CHUNK][1:], before[1:])
    with torch.no_grad():
        torch.testing.assert_close(after[1][keys.CHUNK], slow_answer(policy, after[1], 2), rtol=0, atol=2e-5)


def test_the_executor_hands_over_the_last_chunk_per_sample_and_forgets_it_at_a_reset(policy):
    policy.start = WarmStart(2)
    seen = []

    class Spy(torch.nn.Module):
        in_keys, out_keys = policy.in_keys, policy.out_keys

        def forward(self, td):
            seen.append(td.select(keys.LAST_CHUNK, keys.ELAPSED, strict=False).clone())
            return policy(td)

    executor = ChunkExecutor(Spy(), n_action_steps=3)
    assert keys.LAST_CHUNK not in executor.in_keys
    td = TensorDict({keys.HISTORY_STATE: torch.zeros(2, 2, 5)}, [2])
    starts = [[True, True], [False, True], [False, False], [False, False]]
    steps, chunks = [], []
    for at, begins in enumerate(starts):
        td[keys.IS_INIT] = torch.tensor(begins)[:, None]
        td[keys.EPISODE_SEED], td[keys.EPISODE_STEP] = torch.zeros(2, 1).long(), torch.full((2, 1), at)
        td = executor(td)
        steps.append(td[keys.NUM_STEPS].flatten().tolist())
        chunks.append(td[keys.CHUNK].clone())
    assert [query[keys.ELAPSED].flatten().tolist() for query in seen] == [[0, 0], [0], [3]]
    assert torch.equal(seen[2][keys.LAST_CHUNK][0], chunks[0][0])
    assert steps == [[8, 8], [8, 8], [8, 8], [2, 8]]


def test_the_ends_of_a_chunk_are_repeated():
    chunk = torch.arange(6.0).reshape(1, 3, 2)
    assert shift_chunk(chunk, torch.tensor([[-1]]), 3)[0, :, 0].tolist() == [0, 0, 2]
    assert shift_chunk(chunk, torch.tensor([[7]]), 2)[0, :, 0].tolist() == [4, 4]


def test_what_cannot_be_served_is_refused_and_changes_nothing(policy, tmp_path):
    with refused("num_steps"):
        WarmStart(0)
    with refused("num_steps"):
        policy.start = WarmStart(8)
    assert policy.start.name == ""
    policy.start = WarmStart(3)
    with refused("num_steps"):
        policy.sampler = Sampler("ddpm", timesteps=[82, 14])
    assert policy.num_inference_steps == 8
    policy.start = Elsewhere()
    with refused("start"):
        policy.save_pretrained(tmp_path / "policy")
    assert not (tmp_path / "policy").exists()


class Elsewhere(QueryStart):
    """A start of another package."""


def test_a_saved_policy_begins_where_it_did(policy, asked, tmp_path):
    policy.start = WarmStart(3)
    policy.save_pretrained(tmp_path, half=False)
    loaded = DiffusionPolicy.from_pretrained(tmp_path)
    assert loaded.start.name == "warm3"
    assert torch.equal(loaded(asked.clone())[keys.CHUNK], policy(asked.clone())[keys.CHUNK])
    policy.start = None
    policy.save_pretrained(tmp_path, half=False)
    assert DiffusionPolicy.from_pretrained(tmp_path).start.name == ""
