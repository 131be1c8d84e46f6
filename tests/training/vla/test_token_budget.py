"""Measuring SpecPrune's budget: replayed policy calls are those of a rollout, and errors those of the executed actions."""

import imageio.v3 as iio
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import InitTracker, StepCounter, TransformedEnv
from torchrl.envs.custom import ToyVLAEnv

from tests.recipe_modules import run
from tests.refusals import refused
from tests.tokens.helpers import CONFIG, LAYERS, PER_CAMERA, later, make_policy, query
from tests.training.vla.rendered import write_demos
from torchrl_sparse import ChunkExecutor, keys
from torchrl_sparse.data.robomimic import Demonstrations
from torchrl_sparse.methods.token_budget import TokenBudget
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.training.vla.token_budget import (
    demonstrated_queries,
    measure_errors,
    measure_success,
    recorded_queries,
    replay,
)
from torchrl_sparse.training.vla.trainer import InstructedDemonstrations


def episode(steps=4):
    """Policy calls of one episode, each []."""
    queries = [query(1)]
    for step in range(1, steps):
        queries.append(later(queries[-1], seed=step))
    return [td[0] for td in queries]


def pruner(alpha):
    return SpecPrune(alpha=alpha, budget=PER_CAMERA, dynamic=False)


def test_replaying_is_what_a_rollout_does():
    policy, queries = make_policy(), episode()
    answers = replay(policy, queries, pruner(0.2))
    worker, td = make_policy(pruner(0.2)), TensorDict({}, [])
    for index, recorded in enumerate(queries):
        td = worker(td.update(recorded))
        for key in (keys.CHUNK, keys.KEPT, keys.TOKEN_DEPTH):
            assert torch.equal(td[key], answers[key][index])
    kept = answers[keys.KEPT]
    assert kept[0] == CONFIG.num_visual > kept[1:].max()
    assert policy.pruner is None
    assert all(keys.TOKEN_SCORE not in recorded.keys(True) for recorded in queries)


def test_errors_are_those_of_the_executed_actions_after_the_first_query():
    policy, queries = make_policy(), episode()
    tight, whole = measure_errors(
        policy, [queries, queries[:1]], {number: pruner(number) for number in (0.2, 1.0)}, n_action_steps=1
    )
    answers = (replay(policy, queries, method)[keys.CHUNK] for method in (None, pruner(0.2)))
    dense, pruned = (policy.normalizer.normalize_action(chunks)[1:, :1] for chunks in answers)
    assert tight.loss == pytest.approx((pruned - dense).abs().mean().item())
    assert tight.loss > 0 == whole.loss
    assert tight.kept < whole.kept == CONFIG.num_visual
    assert (tight.number, whole.number) == (0.2, 1.0)
    with refused("episodes"):
        measure_errors(policy, [queries[:1]] * 2, {0.2: pruner(0.2)}, n_action_steps=1)


def test_queries_of_demonstrations_begin_with_each_episode():
    data = {
        camera: torch.arange(7, dtype=torch.uint8)[:, None, None, None].expand(7, 3, 56, 56)
        for camera in CONFIG.cameras
    }
    state = torch.zeros(7, 8)
    state[:, 0], state[:, 6] = (
        torch.tensor([0.0, 1, 3, 7, 7, 8, 8]),
        1.0,
    )  # x, and a quaternion that does not turn
    data |= {keys.STATE: state, keys.ACTION: torch.zeros(7, 7)}
    episodes = Demonstrations(TensorDict(data, [7]), torch.tensor([0, 3, 7]))
    demos, poses = InstructedDemonstrations(episodes, ["up", "down"]), [(slice(0, 3), slice(3, 7))]
    found = [*demonstrated_queries(make_policy(), demos, 2, poses, control_freq=10.0)]
    assert [[int(td[keys.IMAGE][0, 0, 0]) for td in queries] for queries in found] == [[0, 2], [3, 5]]
    assert [[td[keys.IS_INIT].item() for td in queries] for queries in found] == [[True, False]] * 2
    assert [queries[1][keys.INSTRUCTION] for queries in found] == ["up", "down"]
    # Of the last step alone, whatever lies between two policy calls, and at rest where an episode begins.
    assert [[td[keys.EEF_VEL][0].item() for td in queries] for queries in found] == [[0, 20], [0, 10]]
    assert all(td[keys.EEF_VEL].count_nonzero() <= 1 for queries in found for td in queries)
    back = SpecPrune(alpha=0.2, budget=PER_CAMERA, dynamic=False, look_back=2)
    assert measure_errors(make_policy(), found, {0.2: back}, 1)[0].kept < CONFIG.num_visual
    assert measure_errors(make_policy(), found, {0.2: pruner(0.2)}, 1)[0].kept < CONFIG.num_visual
    # What is drawn at random is drawn alike whatever else is measured.
    few, more = {0.5: RandomPruner(0.5)}, {0.3: RandomPruner(0.3), 0.5: RandomPruner(0.5)}
    assert measure_errors(make_policy(), found, few, 1)[0] == measure_errors(make_policy(), found, more, 1)[1]


def toy_env(seeds):
    sizes = {"action_dim": 7, "state_dim": 14, "image_shape": (3, 28, 28), "success_steps": 9}
    env = TransformedEnv(ToyVLAEnv(**sizes, device="cpu", seed=seeds[0]), InitTracker())
    env.append_transform(StepCounter(5))
    return env


def toy_policy():
    torch.manual_seed(0)
    sizes = {"cameras": (keys.IMAGE,), "llm": TransformerSize(32, LAYERS, 2, 64), "state_dim": 14}
    return VLAPolicy(VLANetwork(VLAConfig.tiny(**sizes)))


def test_recorded_queries_are_those_that_the_executor_made():
    policy = toy_policy()
    found = [*recorded_queries(policy, ChunkExecutor(policy, 2), toy_env, [0, 1])]
    assert [[td[keys.IS_INIT].item() for td in queries] for queries in found] == [[True, False, False]] * 2
    answers = replay(policy, found[0], None)
    steps = toy_env([0]).rollout(9, ChunkExecutor(policy, 2))
    assert torch.equal(answers[keys.CHUNK], steps[keys.CHUNK][steps[keys.QUERIED].squeeze(-1)])


def test_success_is_compared_with_dense_on_the_same_seeds():
    def make_actor(policy):
        made.append(policy.pruner)
        return ChunkExecutor(policy, 2)

    made, pruners = [], {0.25: SpecPrune(alpha=0.25, budget=4), 1.0: SpecPrune(budget=4)}
    points = measure_success(toy_policy(), make_actor, toy_env, [0, 1], pruners)
    assert made == [None, *pruners.values()]
    assert [(point.number, point.loss) for point in points] == [(0.25, 0), (1.0, 0)]  # none ever succeeds
    assert points[0].kept < points[1].kept <= 4


@pytest.mark.parametrize("method", ["specprune", "fastv_dense_first"])
def test_the_recipe_calibrates_from_a_demonstration_file(tmp_path, method):
    torch.manual_seed(0)
    sizes = {"image_size": 56, "state_dim": 9, "action_dim": 10, "llm": TransformerSize(32, LAYERS, 2, 64)}
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(**sizes)), tokenizer=WordTokenizer(["red"]))
    policy.save_pretrained(tmp_path / "policy")
    demos = write_demos(tmp_path / "images.h5", image_size=56)
    options = (
        f"method={method}",
        "numbers=[0.1,0.3]",
        "tolerance=2",
        "episodes=2",
        "n_action_steps=2",
        f"policy={tmp_path}/policy",
    )
    run("calibrate_tokens", f"demos={demos}", *options)
    budget = TokenBudget.from_pretrained(tmp_path / "policy" / f"{method}.json")
    assert (budget.method, budget.number) == (method, 0.1)
    assert [point.number for point in budget.points] == [0.1, 0.3]
    assert budget.points[0].kept < budget.points[1].kept
    policy.pruner = budget.pruner()
    assert iio.imread(tmp_path / "policy" / f"{method}.png").std() > 5
