"""Planners that do not look at the cameras: they decide while the cameras' encoder runs, and answers stay what they were."""

import threading

import pytest
import torch
from tensordict import TensorDict

from tests.policies.diffusion.test_cameras import make_frames
from torchrl_sparse import keys
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.blocks.tts import TTSPruner
from torchrl_sparse.policies.diffusion import policy as policies

FEATURES, STATE = 128, 3


def prune(policy, kind=SAGPruner, unseen=FEATURES, **options):
    torch.manual_seed(1)
    rates = (0.2, 0.4) if options.get("rate_input") else None
    network = PrunerNetwork([50, 0], policy.num_blocks, (2, FEATURES + STATE), unseen=unseen, **options)
    policy.plan = kind(network, PrunerInfo(policy.fingerprint, policy.sampler.name, 0.3, rates))
    return policy


def ask(policy, *batch, turns=2):
    """Return the answers of an episode's first queries."""
    generator, answers, carried = torch.Generator().manual_seed(2), [], {}
    for turn in range(turns):
        query = TensorDict(carried, batch)
        query["history"] = {
            "state": 9 * torch.randn(*batch, 2, STATE, generator=generator),
            **make_frames(*batch, 2),
        }
        query["episode"] = {name: torch.full((*batch, 1), turn) for name in ("seed", "step")}
        query[keys.ELAPSED] = torch.full((*batch, 1), 4 * turn)
        answers.append(policy(query.clone()).exclude(keys.LATENCY))
        carried = {key: answers[-1][key] for key in (keys.QUERY, keys.FEATURES) if key in policy.out_keys}
    return torch.stack(answers)


@pytest.mark.parametrize(
    ("kind", "options"),
    [(SAGPruner, {}), (SAGPruner, {"rate_input": True}), (TTSPruner, {"recalls": True})],
    ids=["sag", "rates", "tts"],
)
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_answers_are_those_of_one_stage_after_the_other(make_image_policy, monkeypatch, kind, options, batch):
    policy = prune(make_image_policy(), kind, **options)
    meanwhile = ask(policy, *batch)
    monkeypatch.setattr(policies, "answer_meanwhile", lambda *_: False)
    in_turn = ask(policy, *batch)
    assert set(meanwhile.keys(True, True)) == set(in_turn.keys(True, True))
    assert (meanwhile == in_turn).all()
    assert meanwhile[keys.PRUNE_MASK].any()


def meet(monkeypatch, policy, timeout):
    """Have encoder and planner each wait until the other has begun."""
    barrier, condition, plan = threading.Barrier(2), policy.module["encode"].condition, policy.plan
    encoded, masks = condition.forward, plan.masks
    monkeypatch.setattr(condition, "forward", lambda td: barrier.wait(timeout) >= 0 and encoded(td))
    monkeypatch.setattr(plan, "masks", lambda *args: barrier.wait(timeout) >= 0 and masks(*args))


def test_the_planner_decides_while_the_encoder_runs(make_image_policy, monkeypatch):
    policy = prune(make_image_policy())
    expected = ask(policy, 2)
    meet(monkeypatch, policy, timeout=30)
    assert (ask(policy, 2) == expected).all()


def test_a_planner_that_looks_at_a_camera_waits_for_it(make_image_policy, monkeypatch):
    policy = prune(make_image_policy(), unseen=FEATURES - 1)
    meet(monkeypatch, policy, timeout=0.1)
    with pytest.raises(threading.BrokenBarrierError):
        ask(policy, 2)


def test_what_fails_is_raised(make_image_policy, monkeypatch):
    policy = prune(make_image_policy())
    with pytest.raises(KeyError, match=r"expected the key \('history', 'image'\)"):
        policy(TensorDict({"history": {"state": torch.zeros(1, 2, STATE)}}, [1]))
    monkeypatch.setattr(policy.plan, "masks", lambda *_: torch.zeros(7, 7))
    with pytest.raises(ValueError, match=r"SAGPruner\.masks: prune mask: expected"):
        ask(policy, 1)
