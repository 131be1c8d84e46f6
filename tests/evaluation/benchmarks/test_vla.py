"""What a benchmark of visual tokens measures: each method with its own controller, on calls that are the same each time."""

import pytest
import torch
import yaml

pytest.importorskip("transformers")

from torchrl.envs import InitTracker, StepCounter, Transform, TransformedEnv
from torchrl.envs.custom import ToyVLAEnv

from tests.recipe_modules import RECIPES
from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.evaluation.benchmarks.vla import (
    check_budgets,
    filmed_methods,
    record_methods,
    token_settings,
)
from torchrl_sparse.evaluation.benchmarks.vla_benchmark import replay_all, time_methods
from torchrl_sparse.methods.vla import TOKEN_METHODS, TokenMethod, make_controller, make_pruner
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.specprune import SpecPrune

STEPS, TURN, LAYERS = 8, 5, 6


class FineLater(torch.nn.Module):
    """Grants 1 token and, from a step on, 3; asks for a policy call there."""

    in_keys = ["step_count"]
    out_keys = [keys.TOKEN_BUDGET, keys.FINE, keys.REPLAN]

    def forward(self, td):
        step = td["step_count"]
        td[keys.TOKEN_BUDGET] = torch.where(step >= TURN, 3.0, 1.0)
        td[keys.FINE] = step >= TURN
        return td.set(keys.REPLAN, step == TURN)


class Numbered(Transform):
    """Says which episode and step it is and how the hand moves, as the environments of this library do."""

    def __init__(self, seed):
        super().__init__()
        self.seed = seed

    def _reset(self, tensordict, tensordict_reset):
        return self._step(tensordict, tensordict_reset)

    def _step(self, tensordict, next_tensordict):
        next_tensordict.set(keys.EPISODE_SEED, torch.tensor([self.seed]))
        next_tensordict.set(keys.EEF_VEL, torch.full((6,), 0.01) * next_tensordict["step_count"])
        return next_tensordict.set(keys.EPISODE_STEP, next_tensordict["step_count"].clone())


def make_env(seeds):
    sizes = {"action_dim": 7, "state_dim": 14, "image_shape": (3, 28, 28), "success_steps": 99}
    env = TransformedEnv(ToyVLAEnv(**sizes, device="cpu", seed=seeds[0]), InitTracker())
    env.append_transform(StepCounter(STEPS))
    env.append_transform(Numbered(seeds[0]))
    return env


@pytest.fixture
def policy():
    torch.manual_seed(0)
    sizes = {
        "cameras": (keys.IMAGE,),
        "llm": TransformerSize(32, LAYERS, 2, 64),
        "state_dim": 14,
        "chunk_size": 4,
    }
    return VLAPolicy(VLANetwork(VLAConfig.tiny(**sizes)))


@pytest.fixture
def recorded(policy, monkeypatch):
    monkeypatch.setitem(TOKEN_METHODS, "turning", TokenMethod(SpecPrune, "alpha", controller=FineLater))
    names = ["dense", "turning", "specprune_uncontrolled@0.1"]
    return record_methods(names, policy, make_env, [0], n_action_steps=4, settings={})


def test_a_controlled_method_is_measured_with_its_controller(policy, recorded):
    assert recorded["dense"] is recorded["specprune_uncontrolled@0.1"]
    queries = recorded["turning"][0]
    assert [query[keys.TOKEN_BUDGET].item() for query in queries] == [1.0, 1.0, 3.0]
    assert [query[keys.FINE].item() for query in queries] == [False, False, True]
    assert all(keys.TOKEN_BUDGET not in query.keys(True) for query in recorded["dense"][0])
    static = {"dynamic": False, "carry": False, "threshold": -1.0}  # the picks of two layers alone
    kept = replay_all(policy.with_pruner(SpecPrune(budget=1, **static)), recorded["turning"])
    coarse, fine = (kept[keys.TOKEN_DEPTH] == LAYERS).sum(-1).tolist()[1:]
    assert coarse <= 2 < 3 <= fine


def test_queries_are_timed_in_turn(policy, recorded, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "torchrl_sparse.evaluation.benchmarks.vla_benchmark.answer", lambda policy, query: asked.append(query)
    )
    policies = {"turning": policy.with_pruner(SpecPrune(budget=2))}
    time_methods(policies, recorded, repeats=4, threads=1, device="cpu")
    warmup = len(asked) - 4
    budgets = [query[keys.TOKEN_BUDGET].item() for query in asked]
    assert budgets == [[1.0, 1.0, 3.0][turn % 3] for turn in range(warmup + 4)]


def test_a_pruner_that_reads_how_the_hand_moves_is_measured(policy):
    looking = policy.with_pruner(SpecPrune(budget=2, look_back=3))
    recorded = record_methods(["random"], policy, make_env, [0], n_action_steps=4, settings={})
    times = time_methods(
        {"looking": looking}, {"looking": recorded["random"]}, repeats=3, threads=1, device="cpu"
    )
    assert times["looking"].n == 3
    assert (replay_all(looking, recorded["random"])[keys.TOKEN_DEPTH] < LAYERS).any()


def test_random_tokens_are_the_same_each_time(policy):
    """The draw follows from the episode and the step, which are recorded with each policy call."""

    recorded = record_methods(["random"], policy, make_env, [3, 4], n_action_steps=4, settings={})["random"]
    worker = policy.with_pruner(make_pruner("random@0.5"))
    first, again = (replay_all(worker, recorded)[keys.TOKEN_DEPTH] for _ in range(2))
    assert torch.equal(first, again)
    assert len({*map(tuple, first.tolist())}) > 1


def test_the_defaults_run_on_the_shipped_policy():
    options = yaml.safe_load((RECIPES / "benchmark_vla.yaml").read_text())
    settings = token_settings(options)
    assert settings["specprune"]["alpha"] == 0.17
    spec = VLAPolicy.from_pretrained(options["policy"]).network.config.visual_spec
    check_budgets(options["methods"], spec, settings)
    with refused("methods: specprune: alpha * budget"):
        check_budgets(options["methods"], spec, token_settings(options | {"calibrated": False}))


@pytest.mark.parametrize(
    ("motion", "given", "steps"),
    [("measured", {}, None), ("commanded", {}, 4), ("commanded", {"chunk_steps": 2}, 2)],
)
def test_a_chunk_is_used_up_when_its_executed_actions_are(motion, given, steps):
    controller = {"motion": motion, **given}
    options = {
        "policy": "none",
        "calibrated": True,
        "specprune": {},
        "controller": controller,
        "n_action_steps": 4,
    }
    assert make_controller("specprune", token_settings(options)).chunk_steps == steps


def test_videos_are_those_of_methods():
    methods = ["dense", "specprune@0.1", "specprune@0.2"]
    assert filmed_methods(["specprune@0.2"], methods) == {"specprune@0.2": "specprune@0.2"}
    for video in ("specprune", "fastv"):
        with refused("videos"):
            filmed_methods([video], methods)
