"""Reuse across queries: against queries written out, per sample, forgotten where an episode begins."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import ChunkExecutor, keys
from torchrl_sparse.blocks.engine.factory import ENGINES
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.recall import Memory
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.mask import MaskError
from torchrl_sparse.blocks.recall import Recall
from torchrl_sparse.networks.diffusion.noise import sample_noise
from torchrl_sparse.policies.diffusion.warm_start import WarmStart


def slow_query(policy, query, recalled, memory):
    """The chunk of one query []; `recalled` are steps, `memory` maps (step, block) to what was computed last."""
    network, sampler = policy.network, policy.sampler
    cond = policy.normalizer.normalize_state(query[keys.HISTORY_STATE])[None]
    noise = sample_noise(query[keys.SEED], sampler.num_inference_steps, (network.horizon, network.input_dim))
    sample = noise[:, 0]
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        x, tokens = network.embed(sample), network.memory(timestep, cond)
        for block in range(network.num_blocks):
            if k not in recalled:
                memory[k, block] = network.block(block, x, tokens)
            x = x + memory[k, block]
        gaussian = noise[:, k + 1] if k + 1 < sampler.num_inference_steps else None
        sample = sampler.step(network.head_out(x), k, sample, gaussian)
    return policy.normalizer.unnormalize_action(sample[0, network.n_obs_steps - 1 :])


@torch.no_grad()
@pytest.mark.parametrize("engine", ["auto", "reference"])
def test_queries_recall_what_was_computed_before_them_in_each_sample_of_its_own(policy, engine):
    """Two samples, four queries; the second sample begins a new episode at the third."""
    policy.plan, policy.engine = Recall(2), engine
    executor = ChunkExecutor(policy, n_action_steps=3)
    assert keys.ELAPSED not in executor.in_keys
    generator, td, at = torch.Generator().manual_seed(0), TensorDict(batch_size=[2]), 0
    expected_steps = [((), ()), ((2, 4, 6), (2, 4, 6)), ((1, 3, 5, 7), ()), ((2, 4, 6), (2, 4, 6))]
    memories = [{}, {}]
    for recalled in expected_steps:
        for _ in range(3):  # a chunk
            td[keys.HISTORY_STATE] = torch.randn(2, 2, 5, generator=generator)
            td[keys.EPISODE_SEED], td[keys.EPISODE_STEP] = torch.tensor([[1], [2]]), torch.full((2, 1), at)
            begins = [at == 0, at in (0, 6)]
            td[keys.IS_INIT], at = torch.tensor(begins)[:, None], at + 1
            td = executor(td)
            if not td[keys.QUERIED].any():
                continue
            for row, query in enumerate(td.unbind(0)):
                memories[row] = {} if begins[row] else memories[row]
                chunk = slow_query(policy, query, recalled[row], memories[row])
                torch.testing.assert_close(query[keys.CHUNK], chunk, rtol=0, atol=1e-5)
    assert td[keys.QUERY].flatten().tolist() == [3, 1]


def test_flops_are_of_what_is_computed(policy):
    policy.plan = Recall(4)
    query = {
        keys.HISTORY_STATE: torch.zeros(2, 2, 5),
        keys.ELAPSED: torch.tensor([[0], [3]]),
        keys.QUERY: torch.tensor([[4], [0]]),
        keys.EPISODE_SEED: torch.zeros(2, 1).long(),
        keys.EPISODE_STEP: torch.zeros(2, 1).long(),
    }
    answered = policy(TensorDict(query, [2]))
    assert answered[keys.PRUNE_MASK].float().mean(dim=(1, 2)).tolist() == [0, 5 / 8]
    assert answered[keys.FLOPS][1] < answered[keys.FLOPS][0] / 2


def test_without_a_memory_a_query_is_dense(policy):
    query = {keys.HISTORY_STATE: torch.zeros(2, 2, 5), keys.ELAPSED: torch.tensor([[3], [8]])}
    policy.plan = Recall(2)
    assert not policy(TensorDict(query, [2]))[keys.PRUNE_MASK].any()


def test_nothing_recalled_is_the_rule_alone(policy):
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(3, 8, 6, generator=generator) < 0.5
    mask[:, 0] = False
    noise, cond = torch.randn(3, 8, 6, 4, generator=generator), torch.randn(3, 2, 5, generator=generator)
    memory = Memory(mask, torch.zeros_like(mask), torch.zeros(3, 8, 6, 6, 32))
    for reuse in ("block", "type"):
        query = policy.network, policy.sampler, noise, cond, mask
        assert torch.equal(denoise(*query, reuse=reuse, replace=memory), denoise(*query, reuse=reuse))
    with pytest.raises(MaskError, match="recall: expected pruned cells alone, got 144 others"):
        Memory(torch.zeros_like(mask), torch.ones_like(mask), memory.outputs)


def test_auto_takes_an_engine_that_recalls_and_says_which_it_passed_over(policy, monkeypatch):
    policy.plan = Recall(2)
    if native_available()[0]:
        assert policy.engine_info().startswith("native: ")
    missing = ENGINES["native"]._replace(applies=lambda network: (False, "it was not built"))
    monkeypatch.setitem(ENGINES, "native", missing)
    policy.engine = "auto"  # anew
    info = (
        "reference: eager and differentiable (not native: it was not built) (not torch: it does not recall)"
    )
    assert policy.engine_info() == info
    assert policy.with_plan(None).engine_info().startswith("torch: ")


def test_what_a_query_leaves_is_a_tensor_of_its_own(policy):
    policy.plan = Recall(2)
    query = TensorDict({keys.HISTORY_STATE: torch.zeros(1, 2, 5), keys.ELAPSED: torch.tensor([[0]])}, [1])
    first = policy(query.clone())
    before = first[keys.FEATURES].clone()
    later = first.clone(recurse=False).set(keys.ELAPSED, torch.tensor([[3]]))
    later.set(keys.HISTORY_STATE, torch.ones(1, 2, 5))
    second = policy(later)
    assert torch.equal(before, first[keys.FEATURES])
    computed = ~second[keys.PRUNE_MASK]
    same = (second[keys.FEATURES] == before).flatten(3).all(dim=-1)
    assert torch.equal(same, ~computed)


@pytest.mark.parametrize("engine", ["auto", "reference"])
def test_gradients_flow_through_a_query_that_recalls(policy, engine):
    policy.plan, policy.engine = Recall(2), engine
    state = torch.zeros(1, 2, 5, requires_grad=True)
    query = {keys.HISTORY_STATE: state, keys.ELAPSED: torch.tensor([[3]]), keys.QUERY: torch.tensor([[0]])}
    policy(TensorDict(query, [1]))[keys.CHUNK].sum().backward()
    assert state.grad.abs().sum() > 0


def test_what_does_not_go_together_is_refused(policy):
    policy.plan = Recall(2)
    with pytest.raises(ValueError, match="start: expected None with a planner that recalls, got warm2"):
        policy.start = WarmStart(2)
    message = r"engine: expected one of \['auto', 'native', 'reference', .*\] with a planner that recalls, got 'torch'"
    with pytest.raises(ValueError, match=message):
        policy.engine = "torch"
    assert keys.FEATURES in policy.out_keys
    policy.plan = None
    assert keys.FEATURES not in policy.out_keys
    policy.engine = "torch"
    with pytest.raises(ValueError, match=message):
        policy.plan = Recall(2)
    assert keys.FEATURES not in policy.out_keys
    with pytest.raises(ValueError, match="interval: expected at least 2, got 1"):
        Recall(1)
