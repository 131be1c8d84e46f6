"""A choice for each cell, one for all queries or one of each: against queries written out, and a schedule through its file."""

import json

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import ChunkExecutor, DiffusionPolicy, keys, load_planner
from torchrl_sparse.blocks.mask import MaskError
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.recall import RecallSchedule
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo
from torchrl_sparse.blocks.tts import TTSPruner
from torchrl_sparse.networks.diffusion.noise import sample_noise


def some_cells(num_steps, num_blocks, seed=0):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(num_steps, num_blocks, generator=generator) < 0.6
    mask[0] = False
    return mask, mask & (torch.rand(num_steps, num_blocks, generator=generator) < 0.5)


def schedule_for(policy, reuse="block"):
    return RecallSchedule(*some_cells(8, policy.num_blocks), policy.plan.spec, reuse)


def pruner_for(policy, reuse="block"):
    """An untrained one: whatever it chooses, it chooses for each observation."""
    torch.manual_seed(0)
    shape = policy.n_obs_steps, policy.network.cond_dim
    network = PrunerNetwork(policy.sampler.timesteps.tolist(), policy.num_blocks, shape, recalls=True)
    with torch.no_grad():
        network.obs.weight *= 30
        network.mlp[-1].bias.zero_()
    spec = policy.plan.spec
    return TTSPruner(network, PrunerInfo(spec.policy, spec.sampler, 0.5, reuse=reuse))


def slow_query(policy, query, reuse, memory):
    """The chunk of one query []; ``memory`` maps (step, block) to what was computed last, and is empty in the first query."""
    network, sampler, first = policy.network, policy.sampler, not memory
    cond = policy.normalizer.normalize_state(query[keys.HISTORY_STATE])[None]
    noise = sample_noise(query[keys.SEED], sampler.num_inference_steps, (network.horizon, network.input_dim))
    sample, latest, slots = noise[:, 0], {}, 3 if reuse == "type" else network.num_blocks
    mask, recalled = query[keys.PRUNE_MASK], query[keys.RECALL]
    assert not (first and mask.any())
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        x, tokens = network.embed(sample), network.memory(timestep, cond)
        for block in range(network.num_blocks):
            if not mask[k, block]:
                latest[block % slots] = memory[k, block] = network.block(block, x, tokens)
                x = x + latest[block % slots]
            else:
                x = x + (memory[k, block] if recalled[k, block] else latest[block % slots])
        gaussian = noise[:, k + 1] if k + 1 < sampler.num_inference_steps else None
        sample = sampler.step(network.head_out(x), k, sample, gaussian)
    return policy.normalizer.unnormalize_action(sample[0, network.n_obs_steps - 1 :])


@torch.no_grad()
@pytest.mark.parametrize("make", [schedule_for, pruner_for])
@pytest.mark.parametrize("reuse", ["block", "type"])
def test_cells_are_computed_reused_and_recalled_in_each_sample_of_its_own(policy, make, reuse):
    """Two samples, four queries; the second sample begins a new episode at the third."""
    policy.plan = plan = make(policy, reuse)
    executor = ChunkExecutor(policy, n_action_steps=3)
    generator, td, memories = torch.Generator().manual_seed(0), TensorDict(batch_size=[2]), [{}, {}]
    for at in range(12):
        td[keys.HISTORY_STATE] = torch.randn(2, 2, 5, generator=generator)
        td[keys.EPISODE_SEED], td[keys.EPISODE_STEP] = torch.tensor([[1], [2]]), torch.full((2, 1), at)
        begins = [at == 0, at in (0, 6)]
        td[keys.IS_INIT] = torch.tensor(begins)[:, None]
        td = executor(td)
        if not td[keys.QUERIED].any():
            continue
        for row, query in enumerate(td.unbind(0)):
            memories[row] = {} if begins[row] else memories[row]
            chunk = slow_query(policy, query, reuse, memories[row])
            torch.testing.assert_close(query[keys.CHUNK], chunk, rtol=0, atol=1e-5)
    mask, recalled = td[keys.PRUNE_MASK], td[keys.RECALL]
    assert recalled.any()
    if make is schedule_for:
        assert torch.equal(mask, plan.mask.expand(2, -1, -1))
        assert torch.equal(recalled, plan.chosen.expand(2, -1, -1))
    else:
        assert (mask[0] != mask[1]).any()
        assert (recalled[0] != recalled[1]).any()


def test_its_file_says_what_is_done_with_each_cell(policy, tmp_path):
    plan = schedule_for(policy, "type")
    plan.settings["attempts"] = 7
    plan.save_pretrained(tmp_path / "recalling.json")
    read = load_planner(tmp_path / "recalling.json", policy.plan.spec)
    assert (read.fingerprint, read.reuse, read.made_for, read.settings) == (
        plan.fingerprint, "type", policy.plan.spec, {"attempts": 7}
    )  # fmt: skip
    cells = json.loads((tmp_path / "recalling.json").read_text())["cells"]
    assert all(letters.startswith("C") and len(letters) == 8 for letters in cells.values())
    assert sum(letters.count("R") for letters in cells.values()) == plan.chosen.sum()
    policy.plan = plan
    policy.save_pretrained(tmp_path / "policy", half=False)
    again = DiffusionPolicy.from_pretrained(tmp_path / "policy")
    assert again.plan.fingerprint == plan.fingerprint
    assert (again.plan.reuse, again.engine) == ("type", "auto")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cells": {}}, r"cells: expected layers.0.SA to layers.1.FFN, got none"),
        ({"letter": "CX------"}, r"cells of layers.0.CA: expected 8 letters of C, - and R, got 'CX------'"),
        ({"letter": "C"}, r"cells of layers.0.CA: expected 8 letters of C, - and R, got 'C'"),
        ({"letter": "R-------"}, r"expected row 0 .* got True for layers.0.CA"),
        ({"num_layers": 10**9}, r"num_layers: expected"),
        ({"num_inference_steps": 0}, r"num_inference_steps: expected"),
        ({"sampler": "magic"}, r"magic"),
        ({"reuse": "never"}, r"reuse"),
        ({"settings": []}, r"settings"),
    ],
)
def test_a_file_that_is_none_is_named(policy, tmp_path, change, message):
    path = tmp_path / "odd.json"
    schedule_for(policy).save_pretrained(path)
    stored = json.loads(path.read_text())
    if "letter" in change:
        stored["cells"]["layers.0.CA"] = change["letter"]
    else:
        stored |= change
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=rf"odd.json: .*{message}"):
        load_planner(path)


def test_only_pruned_cells_are_recalled_and_only_for_its_policy(policy):
    mask, recalled = some_cells(8, policy.num_blocks)
    with pytest.raises(MaskError, match="recall: expected pruned cells alone"):
        RecallSchedule(mask, ~mask, policy.plan.spec)
    with pytest.raises(MaskError, match="prune mask: expected shape"):
        RecallSchedule(mask, recalled, PlanSpec(9, 2, "8d1f"))
    with pytest.raises(ValueError, match="RecallSchedule: made for policy fingerprint 'another'"):
        policy.plan = RecallSchedule(mask, recalled, PlanSpec(8, 2, "another", policy.sampler.name))
