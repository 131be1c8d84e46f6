"""The token pruners of a benchmark by name, matched in tokens, asked in mid-episode; and the recipe, rendered."""

import json

import imageio.v3 as iio
import pytest
import torch

pytest.importorskip("transformers")

from tests.recipe_modules import run
from tests.refusals import refused
from tests.tokens.helpers import CONFIG, later, make_policy, query
from torchrl_sparse import keys
from torchrl_sparse.control.queries import answer
from torchrl_sparse.envs.transforms import make_env
from torchrl_sparse.evaluation import load_results
from torchrl_sparse.evaluation.rollouts.vla_methods import (
    matching_share,
    method_identity,
    prepared_queries,
    seen_images,
)
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens import FastVPruner, RandomPruner, SpecPrune
from torchrl_sparse.training.vla.token_budget import replay


def episode(steps=5):
    queries = [query(1)]
    for step in range(1, steps):
        queries.append(later(queries[-1], seed=step))
    return [td[0] for td in queries]


@pytest.mark.parametrize("make", [FastVPruner, RandomPruner])
def test_a_matching_share_keeps_as_many_tokens(make):
    policy, queries = make_policy(), episode()
    target = replay(policy, queries, SpecPrune(alpha=0.2, budget=8))[keys.KEPT].mean().item()
    share = matching_share(make, policy, [queries], target)
    kept = [replay(policy, queries, make(s))[keys.KEPT].mean().item() for s in (share, share + 2**-9)]
    assert kept[0] <= target <= kept[1] + 1e-4
    assert target - kept[0] <= 1  # token


def test_a_pruner_that_cannot_keep_so_few_is_refused():
    with refused("pruner"):
        matching_share(FastVPruner, make_policy(), [episode(2)], 1.0)


def test_a_number_in_a_methods_name_makes_the_calibrated_one_beside_the_policy_no_other_method():
    policy, settings = make_policy(), {"early": 4}
    plain = method_identity("specprune@0.2", 0.2, policy, {"specprune": settings})
    assert method_identity("specprune@0.2", 0.2, policy, {"specprune": {"alpha": 0.3, **settings}}) == plain
    told = method_identity("specprune", None, policy, {"specprune": {"alpha": 0.3, **settings}})
    assert told["options"] == {"alpha": 0.3, **settings}


def test_prepared_queries_remember_those_before():
    policy = make_policy(SpecPrune(alpha=0.2, budget=8))
    queries = episode()
    prepared = prepared_queries(policy, queries)
    before = [set(query.keys(True)) for query in prepared]
    expected = replay(policy, queries, policy.pruner)
    for _ in range(2):  # asking leaves the policy calls as they are
        for index in (3, 0, 4, 2, 1):
            answered = answer(policy, prepared[index])
            assert torch.equal(answered[keys.CHUNK], expected[index][keys.CHUNK])
            assert torch.equal(answered[keys.TOKEN_DEPTH], expected[index][keys.TOKEN_DEPTH])
    assert [set(query.keys(True)) for query in prepared] == before


def test_images_are_seen_as_the_network_crops_them():
    policy, step = make_policy(), episode(1)[0]
    whole = torch.stack([step[camera] for camera in CONFIG.cameras])
    assert torch.equal(seen_images(policy, step), whole)
    cropped = VLAPolicy(VLANetwork(VLAConfig.tiny(image_size=CONFIG.image_size, crop_area=0.5)))
    assert seen_images(cropped, step).shape == whole.shape
    assert not torch.equal(seen_images(cropped, step), whole)


@pytest.fixture(scope="module")
def policy_folder(tmp_path_factory):
    torch.manual_seed(0)
    sizes = {"state_dim": 9, "action_dim": 10, "chunk_size": 4, "llm": TransformerSize(32, 6, 2, 64)}
    words = WordTokenizer(["lift", "the", "red", "green", "blue", "cube"])
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(image_size=56, **sizes)), tokenizer=words)
    policy.save_pretrained(tmp_path_factory.mktemp("vla") / "policy")
    return tmp_path_factory.getbasetemp() / "vla0" / "policy"


def benchmark(policy, out, *options, expect=0):
    small = ["episodes=2", "horizon=4", "n_action_steps=2", "probe_episodes=1", "latency_repeats=1"]
    return run("benchmark_vla", f"policy={policy}", f"out={out}", *small, *options, expect=expect)


@pytest.fixture
def rendered():
    try:
        make_env("lift", camera="agentview", image_size=14).reset()
    except RuntimeError as error:
        pytest.skip(str(error))


def read_episodes(log):
    """Everything but the times, by seed."""
    episodes = [json.loads(line) for line in log.read_text().splitlines()[1:]]
    return {episode["seed"]: {k: v for k, v in episode.items() if k != "latency"} for episode in episodes}


def test_the_recipe_measures_draws_and_goes_on(rendered, policy_folder, tmp_path):
    printed = benchmark(
        policy_folder,
        tmp_path,
        "methods=[specprune@0.2,fastv@specprune@0.2]",
        "pairs=[[specprune@0.2,fastv@specprune@0.2]]",
        "videos=[specprune]",
        "+specprune.keep_share=0.9",
    )
    whole = load_results(tmp_path / "results.json")
    results = whole.methods
    assert list(results) == ["dense", "specprune@0.2", "fastv@specprune@0.2"]
    kept = [method.tokens.kept_mean for method in results.values()]
    assert kept[0] == 32
    assert kept[1] < 32
    assert abs(kept[2] - kept[1]) < 2
    assert results["specprune@0.2"].prune_rate == pytest.approx(1 - kept[1] / 32)
    assert results["dense"].action_error_vs_dense.max == 0
    assert "| specprune@0.2 | fastv@specprune@0.2 |" in printed
    assert [(pair.method, pair.against, pair.n) for pair in whole.pairs] == [
        ("specprune@0.2", "fastv@specprune@0.2", 2)
    ]
    assert whole.settings["specprune"] == {"keep_share": 0.9}
    assert 0 < whole.settings["numbers"]["fastv@specprune@0.2"] < 1
    cost = results["specprune@0.2"].per_episode
    assert cost.flops == pytest.approx(cost.queries * results["specprune@0.2"].flops.per_query)
    for picture in ("pareto", "tokens_per_layer", "strip_specprune", "control_specprune"):
        assert iio.imread(tmp_path / f"{picture}.png").std() > 5
    frames = iio.imread(tmp_path / "rollout_specprune.mp4")
    assert frames[:8].std() > 5

    log = tmp_path / "episodes" / "dense.jsonl"
    found = read_episodes(log)
    first, *_, last = log.read_text().splitlines(keepends=True)
    log.write_text(first + last)
    benchmark(policy_folder, tmp_path, "methods=[]", "pairs=[]", "videos=[]", "episodes=3")
    assert load_results(tmp_path / "results.json").dense.success.n == 3
    played = read_episodes(log)
    assert found.items() < played.items()
    assert len(played) == 3
    assert sorted(found) == [100000, 100001]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["methods=[specprune@0.5]"],
            "methods: specprune@0.5: alpha * budget: expected more than 0 and at most the model's 16 tokens per camera, got 20",
        ),
        (["methods=[fastv]", "videos=[specprune]"], "videos: expected one of dense, fastv, got 'specprune'"),
        (
            ["+controller.coarce=3", "methods=[specprune@0.1]"],
            "controller: coarce: expected no such key, got 3",
        ),
        (
            ["methods=[fastv@specprune]"],
            "fastv@specprune: expected one of dense after @, got 'specprune'",
        ),
    ],
)
def test_what_cannot_be_played_is_refused_before(policy_folder, tmp_path, options, message):
    assert message in benchmark(policy_folder, tmp_path, "pairs=[]", "videos=[]", *options, expect=2)
    assert not list(tmp_path.iterdir())
