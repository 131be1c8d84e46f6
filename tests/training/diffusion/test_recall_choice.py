"""The search over cells: its judge equals the policy, what it changes keeps the cost, and it goes on where it stopped."""

# ruff: noqa: F811, what is imported are fixtures

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.fixtures.recipes import demos, policy, work  # noqa: F401
from tests.recipe_modules import run
from torchrl_sparse import DiffusionPolicy, Sampler, keys, load_planner
from torchrl_sparse.blocks.mask import BLOCK_TYPES
from torchrl_sparse.blocks.recall import RecallSchedule
from torchrl_sparse.training.diffusion.recall_choice import Choice, RecallJudge, climb_choice, mutate_choice


@pytest.fixture(scope="module")
def lift():
    made = DiffusionPolicy.from_pretrained("assets/lift")
    made.sampler = Sampler("ddpm", 4)
    return made


def some_choice(policy, share=0.6):
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(policy.num_inference_steps, policy.num_blocks, generator=generator) < share
    mask[0] = False
    return Choice(mask, mask & (torch.rand(mask.shape, generator=generator) < 0.3))


def recorded(*lengths):
    generator = torch.Generator().manual_seed(1)
    return [
        TensorDict({keys.COND: torch.randn(length, 2, 19, generator=generator)}, [length])
        for length in lengths
    ]


def make_judge(policy, *lengths, seed=0, draws=2):
    return RecallJudge(policy, recorded(*lengths), draws=draws, n_action_steps=8, reuse="block", seed=seed)


def test_errors_are_those_of_the_policy_query_by_query(lift):
    choice = some_choice(lift)
    judge = make_judge(lift, 2, 3, draws=1)
    first, second = judge.errors(choice)
    assert (len(first), len(second)) == (2, 1)
    planned = lift.with_plan(RecallSchedule(choice.mask, choice.recalled, lift.plan.spec))
    states, expected = recorded(3)[0], []
    judge = RecallJudge(lift, [states], draws=1, n_action_steps=8, reuse="block", seed=5)
    td, generator = TensorDict(batch_size=[1]), torch.Generator().manual_seed(5)
    for turn in range(3):
        td[keys.COND] = states[keys.COND][turn][None]
        td[keys.SEED] = torch.randint(2**62, (1, 1), generator=generator)
        td[keys.ELAPSED] = torch.full((1, 1), 8 * (turn > 0))
        for stage in ("plan", "denoise"):
            td = planned.module[stage](td)
        dense = lift.module["denoise"](lift.module["plan"](td.select(keys.COND, keys.SEED)))
        answered, wanted = (lift.normalizer.normalize_action(one[keys.CHUNK][:, :8]) for one in (td, dense))
        expected.append((answered - wanted).abs().mean())
    assert expected[0] < 1e-5
    torch.testing.assert_close(
        torch.cat(judge.errors(choice)), torch.stack(expected[1:]), atol=1e-5, rtol=1e-4
    )
    assert judge.error(choice) == pytest.approx(torch.stack(expected[1:]).mean().item(), abs=1e-5)


@pytest.mark.parametrize("recalls", [False, True])
def test_changes_keep_the_cost_of_each_type_and_the_first_step(lift, recalls):
    choice, rng = some_choice(lift), np.random.default_rng(0)
    start, seen = choice, {"mask": 0, "recalled": 0}
    for _ in range(200):
        tried = mutate_choice(choice, rng, recalls=recalls)
        for kind in range(len(BLOCK_TYPES)):
            assert tried.mask[:, kind::3].sum() == start.mask[:, kind::3].sum()
        assert not tried.mask[0].any()
        assert not (tried.recalled & ~tried.mask).any()
        for name in seen:
            seen[name] += not torch.equal(getattr(tried, name), getattr(choice, name))
        if not recalls:
            assert tried.recalled.sum() == start.recalled.sum()
        choice = tried
    assert min(seen.values()) > 20
    nothing = Choice(torch.zeros(3, 6, dtype=torch.bool), torch.zeros(3, 6, dtype=torch.bool))
    assert not mutate_choice(nothing, rng, recalls=recalls).mask.any()


def test_a_climb_goes_on_where_it_stopped_and_never_falls(lift):
    judge, start, errors = make_judge(lift, 2, 2), some_choice(lift), []
    whole = climb_choice(judge, start, 12, on_attempt=lambda best, done: errors.append(judge.error(best)))
    half = climb_choice(judge, start, 5)
    resumed = climb_choice(judge, half, 12, done=5)
    assert torch.equal(whole.mask, resumed.mask)
    assert torch.equal(whole.recalled, resumed.recalled)
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < judge.error(start)


def test_episodes_of_one_query_say_nothing(lift):
    with pytest.raises(ValueError, match="episodes: expected one of two queries or more, got none"):
        make_judge(lift, 1, 1)


def test_the_recipe_goes_on_from_its_files(work, policy):
    out, few = work / "recall", ("sampler=ddpm4", "methods=[bac_unified]", "num_updates=2")
    run("calibrate_bac", f"policy={policy}", *few, f"out={work}/few")
    small = ("episodes=2", "horizon=24", "draws=3", "checkpoint_every=1")
    options = (f"policy={policy}", f"schedule={work}/few/bac_unified_ddpm4.json", *small, f"out={out}")
    assert "methods=[dense,swapped,recalling]" in run("search_recall", *options, "attempts=1")
    output = run("search_recall", *options, "attempts=3")
    assert "error: start 0." in output
    found = json.loads((out / "choice.json").read_text())
    assert found["seen"]["recalling"] <= found["seen"]["start"]
    plan = load_planner(out / "recalling.json")
    assert plan.settings["attempts"] == 3
    assert plan.chosen.float().mean().item() == pytest.approx(found["recalled"])
    alone = (*options[:-1], f"out={work}/recall_alone", "attempts=3")
    run("search_recall", *alone)
    for name in ("recalling.json", "swapped.json", "choice.json"):
        assert (work / "recall_alone" / name).read_bytes() == (out / name).read_bytes()
    refused = run("search_recall", *options, "attempts=3", "seed=1", expect=2)
    assert "swapped.json: made with other settings: seed is 1 here and 0 there" in refused


def test_gates_that_recall_are_trained_and_benchmarked_by_name(work, demos, policy):
    small = ("targets.share=0.4", "train.batch_size=2", "train.max_updates=2", "log_every=1")
    options = (
        "method=tts",
        f"policy={policy}",
        f"demos={demos}",
        "sampler={kind: ddpm, num_inference_steps: 4}",
    )
    training = (*options, *small, "rate=0.5", "spread=1", f"out={work}/tts", "targets.turns=2")
    assert f"planners={work}/tts methods=[dense,pruner,fixed]" in run("train_pruner", *training)
    assert "resumed from step 2" in run("train_pruner", *training)
    few = ("episodes=1", "horizon=20", "latency_repeats=1", "videos=[]", f"out={work}/tts_benchmark")
    run("benchmark", f"policy={policy}", f"planners={work}/tts", "methods=[dense,pruner,fixed]", *few)
    rates = json.loads((work / "tts_benchmark" / "results.json").read_text())["methods"]
    assert 0 < rates["pruner"]["prune_rate"] < 1
    refused = run("looking", f"policy={policy}", f"pruner={work}/tts/pruner", f"out={work}/no", expect=2)
    assert "config.json: format: expected 'torchrl_sparse.sag/1', got 'torchrl_sparse.tts/1'" in refused
    refused = run("train_pruner", *training[:-2], "targets.turns=2", "rollouts=1", f"out={work}/no", expect=2)
    assert "targets.turns: expected 1 with rollouts, got 2" in refused
