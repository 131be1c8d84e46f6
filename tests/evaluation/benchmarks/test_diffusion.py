"""A benchmark's parts: methods with dense first, settled rates, measured runs, and captions that follow an episode."""

from functools import partial
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_sparse import DiffusionPolicy, SAGPruner, Sampler, keys, make_env
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.queries import answer, record_queries
from torchrl_sparse.evaluation.benchmarks.diffusion import make_methods, measure_methods, settle_rates
from torchrl_sparse.evaluation.benchmarks.film import captions
from torchrl_sparse.evaluation.benchmarks.summary import error_to_dense, flops_executed
from torchrl_sparse.evaluation.benchmarks.vla import matches_last
from torchrl_sparse.evaluation.rollouts.episodes import EpisodeResult
from torchrl_sparse.policies.diffusion.warm_start import WarmStart

LIFT = Path("assets/lift")


@pytest.fixture(scope="module")
def policy():
    policy = DiffusionPolicy.from_pretrained(LIFT)
    policy.sampler = Sampler("ddim", 4)
    return policy


@pytest.fixture(scope="module")
def queries(policy):
    return record_queries(ChunkExecutor(policy), partial(make_env, "Lift", horizon=12), [7, 8])


def test_every_query_is_recorded_with_its_answer(policy, queries):
    assert queries[keys.EPISODE_SEED].flatten().tolist() == [7, 7, 8, 8]
    assert queries[keys.EPISODE_STEP].flatten().tolist() == [0, 8, 0, 8]
    before = queries.clone()
    torch.testing.assert_close(answer(policy, queries)[keys.CHUNK], queries[keys.CHUNK])
    assert (queries == before).all()


def test_dense_comes_first_and_once():
    policy = DiffusionPolicy.from_pretrained(LIFT)
    options = {"num_updates": 10, "planners": LIFT, "calibration": lambda: pytest.fail("nothing to compute")}
    methods = make_methods(["ddim10", "dense", "ddim10"], policy, **options)
    assert list(methods) == ["dense", "ddim10"]
    assert methods["dense"].num_inference_steps == 100
    assert methods["ddim10"].network is policy.network


def test_a_rate_that_moves_settles_at_the_mean_of_its_episodes_within_its_bounds():
    policy = DiffusionPolicy.from_pretrained("assets/can/weaker")
    for mean, settled in ((0.6, 0.6), (0.9, 0.8), (0.1, 0.5)):
        moved = policy.with_plan(SAGPruner.from_pretrained("assets/can/weaker/sag_rates"))
        settle_rates({"sag_rates@0.8-0.5": moved}, {"sag_rates@0.8-0.5": [_episode(0, mean)]})
        assert moved.plan.rate == settled
    fixed = policy.with_plan(SAGPruner.from_pretrained("assets/can/weaker/sag_rates"))
    before = fixed.plan.rate
    settle_rates({"sag_rates@0.7": fixed}, {"sag_rates@0.7": [_episode(0, 0.5)]})
    assert fixed.plan.rate == before


def test_all_methods_are_measured_on_the_same_queries(policy, queries):
    fewer = policy.with_plan(None, Sampler("ddim", 2))
    methods = {"dense": policy, "ddim2": fewer}
    episodes = {name: [_episode(7), _episode(8)] for name in methods}
    runs = measure_methods(methods, episodes, queries, repeats=2, threads=1)
    assert runs["dense"].action_error[1] < 1e-5 < runs["ddim2"].action_error[0]
    assert runs["ddim2"].latency.n == 2
    assert runs["ddim2"].planning is None
    assert runs["ddim2"].episodes == episodes["ddim2"]


def test_other_noise_is_no_other_computation_and_has_denses_time(policy, queries):
    methods = {"dense": policy, "dense_noise": policy.with_noise(1)}
    episodes = {name: [_episode(7), _episode(8)] for name in methods}
    runs = measure_methods(methods, episodes, queries, repeats=2, threads=1)
    assert runs["dense_noise"].latency is runs["dense"].latency
    assert runs["dense_noise"].action_error[0] > 0.01
    assert runs["dense_noise"].executed_flops == runs["dense"].executed_flops


def test_executed_flops_are_those_of_the_steps_that_queries_took(policy, queries):
    warm = policy.with_plan(None, start=WarmStart(2))
    shorter = policy.with_plan(None, policy.sampler.last_steps(2))
    alone = flops_executed(shorter, answer(shorter, queries[:1]))
    assert flops_executed(policy, queries) == flops_executed(policy, queries[:1])
    first, second = answer(warm, queries[:2]).split(1)
    assert flops_executed(warm, first) == flops_executed(policy, queries)
    assert flops_executed(warm, second) == pytest.approx(alone)


def test_errors_are_of_normalised_actions(policy, queries):
    shifted = queries.clone()
    normal = policy.normalizer.normalize_action(queries[keys.CHUNK])
    shifted[keys.CHUNK] = policy.normalizer.unnormalize_action(normal + 0.25)
    assert error_to_dense(policy, shifted, queries) == pytest.approx((0.25, 0.25), abs=1e-5)


def test_captions_carry_the_latest_query_and_the_success_that_a_step_brings():
    steps = TensorDict(
        {
            keys.QUERIED: torch.tensor([[True], [False], [True]]),
            keys.LATENCY: torch.tensor([[0.25], [0.0], [0.5]]),
            ("next", keys.SUCCESS): torch.tensor([[False], [False], [True]]),
        },
        [3],
    )
    made = captions("bac", steps)
    assert [caption.latency for caption in made] == [0.25, 0.25, 0.5]
    assert [caption.queried for caption in made] == [True, False, True]
    assert [caption.success for caption in made] == [False, False, True]
    assert [caption.step for caption in made] == [0, 1, 2]


def test_methods_that_match_others_run_after_them():
    asked = ["fastv@specprune", "dense", "random@specprune", "specprune"]
    assert matches_last(asked) == ["dense", "specprune", "fastv@specprune", "random@specprune"]


def _episode(seed, prune_rate=0.0):
    return EpisodeResult(seed, True, 8, 1, 10.0, prune_rate)
