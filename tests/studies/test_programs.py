"""Every study as a program, at toy size."""

# ruff: noqa: F811, what is imported are fixtures

import json

import imageio.v3 as iio
import pytest

from recipes.studies.offline_errors.results import load_offline
from tests.fixtures.recipes import demos, policy, schedules, work  # noqa: F401
from tests.recipe_modules import run
from torchrl_sparse.blocks.schedule import CacheSchedule

METHODS = ["dense", "ddpm4", "ddim4_eta0.5", "uniform2_ddpm4", "bac_ddpm4"]


def load_tried(folder):
    return json.loads((folder / "tried.json").read_text())["chains"]


def test_how_much_noise_a_chain_carries(work, demos, policy):
    chains = ("samplers=[ddim2,ddpm2_logsnr]", "draws=3", "targets.share=0.1", f"out={work}/noise")
    printed = run("studies.carried_noise", f"policy={policy}", f"demos={demos}", *chains)
    assert "ddim2: correlation" in printed
    assert {path.suffix for path in (work / "noise").iterdir()} == {".json", ".png"}


def test_masks_and_timesteps_are_searched_and_a_search_goes_on(work, demos, policy):
    search = ("lengths=[3]", "targets.share=0.1", "draws=3", "search.population=2", "random_masks=1")
    searched = (f"policy={policy}", f"demos={demos}", *search, f"out={work}/searched")
    assert "searched.json: ddpm_" in run("studies.search_schedule", *searched, "search.generations=1")
    tried = load_tried(work / "searched")
    output = run("studies.search_schedule", *searched, "search.generations=2")
    assert f"planners={work}/searched methods=[dense,searched]" in output
    assert load_tried(work / "searched")[: len(tried)] == tried
    assert CacheSchedule.from_pretrained(work / "searched" / "searched.json").num_inference_steps == 3
    refused = run("studies.search_schedule", *searched, "search.generations=2", "budget=1", expect=2)
    assert "tried.json: made with other settings: budget is 1 here and 2 there" in refused


@pytest.fixture(scope="module")
def table(work, policy, schedules):
    """A table of episodes of methods whose chains end at timestep 0: this policy has learned too little to end elsewhere."""
    few = ("episodes=1", "horizon=16", "latency_repeats=2", "probe_episodes=1", f"planners={schedules}")
    run("benchmark", f"policy={policy}", f"methods=[{','.join(METHODS)}]", *few, f"out={work}/few")
    return work / "few" / "results.json"


def test_offline_errors_are_held_against_episodes(work, demos, policy, schedules, table):
    options = (f"policy={policy}", f"demos={demos}")
    measured = (f"results=[{table}]", f"planners={schedules}", "draws=3", "targets.share=0.1")
    output = run("studies.offline_errors", *options, *measured, f"out={work}/offline")
    assert "results.json, 4 methods: success" in output
    assert {path.suffix for path in (work / "offline").iterdir()} == {".json", ".png"}
    assert [*load_offline(work / "offline" / "offline_errors_Lift.json").errors] == METHODS
    aggregate = f"aggregate=[{work}/offline/offline_errors_Lift.json]"
    assert "few, 4 |" in run("studies.offline_errors", aggregate, f"out={work}/together")
    assert {path.suffix for path in (work / "together").iterdir()} == {".json", ".png"}
    other = "results=[assets/can/weaker/development/results_development.json]"
    refused = run("studies.offline_errors", *options, other, f"out={work}/no", expect=2)
    assert (
        "results: assets/can/weaker/development/results_development.json: expected a table of Lift, got one of PickPlaceCan"
        in refused
    )
    assert not (work / "no").exists()


def test_whether_masks_follow_observations(work, demos, policy):
    training = (
        f"policy={policy}", f"demos={demos}", "sampler={kind: ddim, num_inference_steps: 5}", "targets.share=0.3",
        "rate=0.5", "train.max_updates=2", "train.batch_size=4",
    )  # fmt: skip
    run("train_pruner", *training, f"out={work}/sag", "train.rate_range=[0.3,0.7]")
    pruner, few = f"pruner={work}/sag/pruner", ("episodes=2", "samples=2")
    oracle = ("oracle.attempts=2", "oracle.draws=3", f"out={work}/looking")
    looked = run("studies.looking", f"policy={policy}", pruner, *few, *oracle)
    assert "own_minus_mean: " in looked
    assert "query minus all: " in looked
    assert "reuse of own: cosine similarity" in looked
    for name in ("looking_Lift.png", "reuse_sources_Lift.png"):
        assert iio.imread(work / "looking" / name).std() > 5
    refused = run("studies.looking", f"policy={policy}", "oracle.attempts=1", f"out={work}/no", expect=2)
    assert "oracle.attempts: expected 0 without a pruner, got 1" in refused
