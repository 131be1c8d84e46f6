"""The published tables follow from the published episodes, and those from the published policies and planners."""

import json
from pathlib import Path

import pytest

from tests.pinned.actions import is_kept, is_removed, is_vla, policy_of
from torchrl_sparse.blocks.planner import tensors_fingerprint
from torchrl_sparse.envs.seeds import evaluation_seeds
from torchrl_sparse.evaluation.results.realtime import load_realtime
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.evaluation.rollouts.episodes import read_episodes, read_identity
from torchrl_sparse.evaluation.statistics.intervals import paired_difference
from torchrl_sparse.methods.diffusion import make_method, method_identity
from torchrl_sparse.networks.fingerprint import is_same_policy
from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.json import describe_differences

ASSETS = Path(__file__).parents[1] / "assets"
FOLDERS = sorted(path.parent for path in ASSETS.rglob("episodes"))
CARDS = sorted(
    {path.parent for path in ASSETS.rglob("model.safetensors")} | {ASSETS / "square" / "weaker"}
)  # whose weights are not kept
UNKEPT = [folder for folder in FOLDERS if not is_kept(folder)]
SEEING = [folder for folder in FOLDERS if is_vla(policy_of(folder))]


def name(folder: Path) -> str:
    return folder.relative_to(ASSETS).as_posix()


def logs(folder: Path) -> dict[str, Path]:
    return {path.name.removesuffix(".jsonl.gz"): path for path in (folder / "episodes").iterdir()}


def outcomes(log: Path) -> dict[int, bool]:
    return {episode.seed: episode.success for episode in read_episodes(log)}


@pytest.mark.parametrize("folder", CARDS, ids=name)
def test_a_policy_has_a_short_card_and_held_out_results(folder):
    assert (folder / "README.md").read_text(encoding="utf-8").count("\n") <= 60
    assert load_results(folder / "results.json").split == "test"


@pytest.mark.parametrize("folder", [path for path in FOLDERS if path not in [*SEEING, *UNKEPT]], ids=name)
def test_episodes_belong_to_the_policy_and_the_planners_beside_them(folder):
    planners = policy_of(folder)
    policy = DiffusionPolicy.from_pretrained(planners)
    for name, log in logs(folder).items():
        if is_removed(name):
            assert read_identity(log)["method"] == name
            assert is_same_policy(read_identity(log)["policy"], policy.fingerprint)
            continue
        method = make_method(name, policy, num_updates=10, planners=planners, calibration=pytest.fail)
        published = read_identity(log)
        asked = published | method_identity(name, method)
        assert not describe_differences(published, json.loads(json.dumps(asked))), log


@pytest.mark.parametrize("folder", UNKEPT, ids=name)
def test_episodes_of_a_policy_that_is_not_kept_belong_to_one_which_is_not_the_kept_one(folder):
    kept = json.loads((policy_of(folder) / "bac.json").read_text(encoding="utf-8"))["policy"]
    found = {read_identity(log)["policy"] for log in logs(folder).values()}
    assert len(found) == 1
    assert kept not in found


@pytest.mark.parametrize("folder", SEEING, ids=name)
def test_episodes_belong_to_the_policy_that_sees(folder):
    policy = VLAPolicy.from_pretrained(policy_of(folder))
    weights = tensors_fingerprint(policy.state_dict())
    for name, log in logs(folder).items():
        assert (read_identity(log)["policy"], read_identity(log)["method"]) == (weights, name)


@pytest.mark.parametrize("folder", FOLDERS, ids=name)
def test_tables_count_the_episodes(folder):
    played = {name: outcomes(log) for name, log in logs(folder).items()}
    tabled = set()
    for path in sorted(folder.glob("results*.json")):
        results = load_results(path)
        for name in results.methods.keys() & played.keys():
            success, paired = results.methods[name].success, results.methods[name].paired_vs_dense
            seeds = range(results.first_seed, results.first_seed + success.n)
            ours, dense = ([played[method][seed] for seed in seeds] for method in (name, "dense"))
            assert success.k == sum(ours), (path, name)
            if name != "dense":
                difference = paired_difference(ours, dense, paired.margin)
                assert paired.diff == pytest.approx(difference.diff)
                if results.until_conclusive is None:  # else the interval is wider, for all the looks
                    assert paired.verdict == difference.verdict
            tabled.add(name)
    assert tabled == played.keys()


@pytest.mark.parametrize("path", sorted(ASSETS.rglob("realtime.json")), ids=name)
def test_late_tables_count_the_late_episodes(path):
    results = load_realtime(path)
    policies = set()
    for method, told in results.methods.items():
        for point in told.points:
            if not point.delay_steps:  # those of an ordinary table beside it
                continue
            log = next(path.parent.rglob(f"{method}_delay{point.delay_steps}.jsonl.gz"))
            policies.add(read_identity(log)["policy"])
            episodes = {episode.seed: episode for episode in read_episodes(log)}
            played = [
                episodes[seed] for seed in evaluation_seeds(results.split, results.seed, point.success.n)
            ]
            times = [episode.length if episode.success else results.episode_horizon for episode in played]
            assert point.success.k == sum(episode.success for episode in played), log
            assert point.restricted_mean_time == pytest.approx(sum(times) / len(times)), log
    assert len(policies) == 1


@pytest.mark.parametrize("path", sorted(ASSETS.rglob("realtime.json")), ids=name)
def test_without_latency_tables_count_ordinary_episodes(path):
    results = load_realtime(path)
    folder = path.parent.parent if path.parent.name == "delayed" else path.parent
    for method, told in results.methods.items():
        for point in (point for point in told.points if not point.delay_steps):
            seeds = evaluation_seeds(results.split, results.seed, point.success.n)
            logs = [
                {episode.seed: episode.success for episode in read_episodes(log)}
                for log in folder.rglob(f"episodes/{method}.jsonl.gz")
            ]
            counts = {sum(log[seed] for seed in seeds) for log in logs if log.keys() >= {*seeds}}
            assert point.success.k in counts, method


@pytest.mark.parametrize("path", sorted(ASSETS.glob("vla/libero/results_*.json")), ids=name)
def test_the_walk_through_libero_counts_its_episodes(path):
    results = load_results(path)
    for method, told in results.methods.items():
        episodes = [*read_episodes(path.parent / results.task / f"{method}.jsonl")]
        seeds = evaluation_seeds(results.split, results.seed, told.success.n)
        assert sorted(episode.seed for episode in episodes) == [*seeds]
        assert told.success.k == sum(episode.success for episode in episodes)
        assert told.episode_length == sum(episode.length for episode in episodes) / len(episodes)
        assert told.flops.per_query == pytest.approx(
            sum(episode.flops_total for episode in episodes) / sum(episode.queries for episode in episodes)
        )
