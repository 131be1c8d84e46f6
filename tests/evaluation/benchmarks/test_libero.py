"""From a folder as OpenVLA-OFT is published to a table of a LIBERO suite: on scenes in LIBERO's stead, and on its own."""

import importlib.util
import json

import hydra
import pytest
from omegaconf import OmegaConf

pytest.importorskip("transformers")

from tests.envs.test_libero_suite import made  # noqa: F401
from tests.recipe_modules import RECIPES, load_recipe, run
from tests.refusals import refused
from tests.storage.published import openvla
from torchrl_sparse.cli.options import check_options
from torchrl_sparse.envs import instructed
from torchrl_sparse.envs.libero import SUITES
from torchrl_sparse.evaluation import load_results

needs_libero = pytest.mark.skipif(importlib.util.find_spec("libero") is None, reason="no LIBERO")
SMALL = ("heads=[4,2,4]", "n_action_steps=2", "latency_repeats=1", "probe_episodes=1", "pairs=[]")


@pytest.fixture
def published(tmp_path):
    """A folder with statistics of every suite, as that of the policy which was trained on all of them."""
    folder = tmp_path / "published"
    folder.mkdir()
    weights = (openvla.make_tensors(), *openvla.make_heads())
    openvla.write(folder, *({name: value.bfloat16() for name, value in part.items()} for part in weights))
    statistics = {f"{suite}_no_noops": openvla.statistics() for suite in SUITES}
    (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    return folder


def test_a_published_folder_plays_a_suite(made, published, tmp_path, monkeypatch, capsys):  # noqa: F811
    monkeypatch.setattr(instructed, "require_libero", lambda: None)
    methods = "methods=[specprune@0.05,random@specprune@0.05]"
    options = [f"policy={published}", "task=libero_object", "split=test", "episodes=2", "horizon=4", *SMALL]
    with hydra.initialize_config_dir(str(RECIPES), version_base=None):
        config = hydra.compose(
            "benchmark_vla", [*options, methods, "videos=[specprune]", f"out={tmp_path}/out"]
        )
    check_options("benchmark_vla", OmegaConf.to_container(config))
    load_recipe("benchmark_vla").main.__wrapped__(config)
    results = load_results(tmp_path / "out" / "results.json")
    assert (results.schema, results.task, results.split, results.episode_horizon) == (
        2,
        "libero_object",
        "test",
        4,
    )
    assert {(suite, size, released) for suite, _, size, released, _ in made} == {("libero_object", 28, True)}
    assert {task for _, task, *_ in made} == {0, 1}
    for method in results.methods.values():
        assert (method.success.k, method.success.n) == (2, 2)
        assert method.restricted_mean_time == 3
        assert method.tokens.kept_mean <= 8
    lines = (tmp_path / "out" / "episodes" / "dense.jsonl").read_text().splitlines()
    assert [json.loads(line)["seed"] for line in lines[1:]] == [210_000, 210_001]
    assert "libero_object, 2 paired episodes" in capsys.readouterr().out
    assert (tmp_path / "out" / "rollout_specprune.mp4").stat().st_size > 0


@pytest.mark.parametrize(
    ("option", "entry"),
    [
        ("task=libero_90", "task"),
        ("episodes=501", "seed"),
        ("policy=assets/vla", "policy"),
        ("policy=assets/lift", "config.json: format"),
    ],
)
def test_what_cannot_be_played_is_refused(made, published, tmp_path, monkeypatch, option, entry):  # noqa: F811
    monkeypatch.setattr(instructed, "require_libero", lambda: None)
    options = [f"policy={published}", "task=libero_goal", "split=test", "methods=[]", "videos=[]", *SMALL]
    options += ["heads=null"] if "policy" in option else []  # which are said of published folders alone
    with hydra.initialize_config_dir(str(RECIPES), version_base=None):
        config = hydra.compose("benchmark_vla", [*options, f"out={tmp_path}/out", option])
    with refused(entry):
        load_recipe("benchmark_vla").main.__wrapped__(config)
    assert not (tmp_path / "out").exists()


@needs_libero
@pytest.mark.parametrize("suite", SUITES)
def test_a_task_of_every_suite_is_benchmarked(published, tmp_path, suite):
    options = (
        "methods=[random@0.5]",
        "episodes=1",
        f"seed={[*SUITES].index(suite)}",
        "horizon=3",
        "videos=[]",
    )
    run("benchmark_vla", f"policy={published}", f"task={suite}", f"out={tmp_path}/out", *SMALL, *options)
    results = load_results(tmp_path / "out" / "results.json")
    assert (results.task, results.first_seed) == (suite, 100_000 + [*SUITES].index(suite))
    assert {name: method.success.n for name, method in results.methods.items()} == {
        "dense": 1,
        "random@0.5": 1,
    }
    assert results.methods["dense"].per_episode.queries == 2
