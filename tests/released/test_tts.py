"""TTS: what our engines and our training compute is what the release computes."""

import pytest
import torch

pytest.importorskip("TTSInfer", reason="needs a checkout of ky-ji/Test-time-Sparsity on PYTHONPATH")

from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.blocks.engine.reference import first_memory
from torchrl_sparse.blocks.sag.relaxed import Recalled, denoise_relaxed

from . import tts

BATCH, STEPS, QUERIES = 3, 5, 4


@pytest.fixture
def policy():
    policy = DiffusionPolicy.from_pretrained("assets/lift", engine="native")
    policy.sampler = Sampler("ddpm", STEPS)
    return policy


def queries(policy, batch):
    generator = torch.Generator().manual_seed(1)
    for turn in range(QUERIES):
        cond = torch.randn(batch, policy.n_obs_steps, policy.network.cond_dim, generator=generator)
        seeds = torch.arange(batch) + 100 * turn
        yield {"cond": cond, "noise": policy.sample_noise(seeds)}


def pruner_for(policy, rule):
    """One whose choices vary, of which the reuse that our planners do not mix is never one."""
    pruner = tts.make_pruner(policy).eval()
    other = tts.BLOCK if rule == "type" else tts.TYPE
    with torch.no_grad():
        for weight in pruner.parameters():
            torch.nn.init.normal_(weight, std=0.2)
        pruner.head.bias[other] = -1e3
    return pruner


@pytest.mark.parametrize("rule", ["type", "block"])
@torch.no_grad()
def test_an_episode_is_answered_as_the_release_answers_it(policy, rule):
    theirs = tts.released(policy, pruner_for(policy, rule))
    engine, memory, seen = policy.module["denoise"].current_engine(), None, set()
    with tts.ask_on_cpu():
        theirs.reset()
        for query in queries(policy, 1):
            expected = theirs.predict_action(query)["action_pred"]
            chosen = tts.choices(theirs, (STEPS, policy.num_blocks))[None]
            if memory is None:  # the release asks its pruner and computes everything
                chosen = torch.zeros_like(chosen)
                memory = first_memory(policy.network, policy.sampler, query["noise"], query["cond"])
                actions = policy.denoise(query["noise"], query["cond"])
            else:
                asked = query["noise"], query["cond"], chosen > 0, chosen == tts.RECALL, memory
                actions, memory = engine.denoise_recalling(*asked, reuse=rule)
            seen |= set(chosen.flatten().tolist())
            torch.testing.assert_close(actions, expected, atol=1e-5, rtol=0)
    assert seen == {tts.COMPUTE, tts.CHOICES[rule], tts.RECALL}


@pytest.mark.parametrize("rule", ["type", "block"])
def test_the_gradient_of_a_gate_is_that_of_the_release(policy, rule):
    theirs = tts.released(policy, pruner_for(policy, rule), training=True)
    first, second, *_ = queries(policy, BATCH)
    with tts.ask_on_cpu():
        theirs.reset()
        theirs.predict_action(first)
        expected = theirs.predict_action(second)["action_pred"]
    chosen = theirs._cache["gate"]
    chosen.retain_grad()
    expected.square().sum().backward()
    compute, kept, recall = (chosen.grad[..., one] for one in (tts.COMPUTE, tts.CHOICES[rule], tts.RECALL))

    hard = chosen.detach().argmax(-1)
    assert set(hard.unique().tolist()) == {tts.COMPUTE, tts.CHOICES[rule], tts.RECALL}
    gate, recalls = ((hard > 0).float().requires_grad_(), (hard == tts.RECALL).float().requires_grad_())
    memory = first_memory(policy.network, policy.sampler, first["noise"], first["cond"]).detach()
    query = policy.network, policy.sampler, second["noise"], second["cond"], gate
    actions = denoise_relaxed(*query, reuse=rule, detached=True, recalled=Recalled(recalls, memory))
    torch.testing.assert_close(actions, expected, atol=1e-5, rtol=0)
    actions.square().sum().backward()
    later = slice(1, None)  # the first step is computed whatever its gate says
    of_gate = torch.where(recalls > 0, recall, kept) - compute
    close = {"atol": 1e-4, "rtol": 1e-3}
    torch.testing.assert_close(gate.grad[:, later], of_gate[:, later], **close)
    torch.testing.assert_close(recalls.grad[:, later], (gate * (recall - kept))[:, later].detach(), **close)
    assert gate.grad[:, later].abs().min() > 0
