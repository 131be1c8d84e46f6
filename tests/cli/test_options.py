"""The table of options knows those of every recipe, and says what each may be."""

from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf

from tests.recipe_modules import RECIPES
from torchrl_sparse.cli.options import OPTIONS, check_options

NAMES = sorted(path.stem for path in RECIPES.glob("*.yaml"))
NEEDED = {"convert_demos": ["demos=a", "out=b"]}


def options(recipe, *overrides):
    with hydra.initialize_config_dir(str(RECIPES), version_base=None):
        config = hydra.compose(recipe, [*NEEDED.get(recipe, []), *overrides])
    return OmegaConf.to_container(config, resolve=True)


@pytest.mark.parametrize("recipe", NAMES)
def test_every_default_is_what_it_may_be(recipe):
    check_options(recipe, options(recipe))


def test_the_table_has_no_word_that_no_recipe_has():
    written = "\n".join((RECIPES / f"{name}.yaml").read_text() for name in NAMES)
    within = {
        "kind",
        "timesteps",
        "obs_width",
        "hidden",
        "batch",
        "analyses",
    }  # of sections that are null or empty
    unused = {key.rpartition(".")[2] for key in OPTIONS if f"{key.rpartition('.')[2]}:" not in written}
    assert unused <= within


@pytest.mark.parametrize(
    ("recipe", "override", "message"),
    [
        ("benchmark", "episodes=abc", "episodes: expected a valid integer, got 'abc'"),
        ("benchmark", "episodes=-3", "episodes: expected greater than or equal to 1, got -3"),
        ("benchmark", "episodes=true", "episodes: expected a valid integer, got True"),
        ("benchmark", "margin=2", "margin: expected less than 1, got 2"),
        ("benchmark", "margin=nan", "margin: expected a finite number, got nan"),
        ("benchmark", "latency_repeats=0", "latency_repeats: expected greater than or equal to 1, got 0"),
        ("benchmark", "methods=bac", "methods: expected a valid list, got 'bac'"),
        ("benchmark", "methods=[]", "methods: expected at least 1 item"),
        ("benchmark", "pairs=[[dense]]", "pairs: 0: expected at least 2 items"),
        ("benchmark", "backend=smoke", "backend: expected 'process' or 'ray', got 'smoke'"),
        ("benchmark", "policy=null", "policy: expected a valid string, got None"),
        ("benchmark", "+foo=1", "foo: expected no such option, got 1"),
        ("collect_demos", "keep_failures=maybe", "keep_failures: expected a valid boolean, got 'maybe'"),
        ("train_policy", "log_every=0", "log_every: expected greater than or equal to 1, got 0"),
        (
            "train_policy",
            "checkpoint_every=0",
            "checkpoint_every: expected greater than or equal to 1, got 0",
        ),
        (
            "train_policy",
            "train.weight_decay=-1",
            "train.weight_decay: expected greater than or equal to 0, got -1",
        ),
        (
            "train_policy",
            "lr_warmup_steps=-1",
            "train.lr_warmup_steps: expected greater than or equal to 0, got -1",
        ),
        ("train_policy", "train=5", "train: expected a valid dictionary, got 5"),
        ("train_policy", "+train.foo=5", "train.foo: expected no such option, got 5"),
        ("train_pruner", "init=3", "init: expected a path or a list of them, got 3"),
        ("train_pruner", "sampler=ddim", "sampler: expected a valid dictionary, got 'ddim'"),
        (
            "train_pruner",
            "sampler={kind: ddim, num_inference_steps: 0}",
            "sampler.num_inference_steps: expected greater",
        ),
        (
            "calibrate_bac",
            "methods=[nope]",
            "methods: 0: expected 'bac', 'bac_blockwise' or 'bac_unified', got 'nope'",
        ),
    ],
)
def test_what_cannot_mean_anything_is_refused(recipe, override, message):
    with pytest.raises(ValueError) as raised:  # noqa: PT011, what it says is compared below
        check_options(recipe, options(recipe, override))
    assert str(raised.value).startswith(message)


@pytest.mark.parametrize(
    ("recipe", "override"),
    [
        ("train_pruner", "init=[a.json,b.json]"),
        ("train_pruner", "sampler={kind: ddim, timesteps: [90, 50, 10]}"),
        ("train_pruner", "train.rate_range=[0.5,0.97]"),
        ("calibrate_bac", "sampler=ddpm_82_14"),
        ("train_vla", "+network.llm.layers=6"),
        ("benchmark_vla", "+specprune.keep_share=0.95"),
        ("benchmark", "margin=0.1"),
        ("realtime", "latencies=[]"),
    ],
)
def test_what_pages_show_is_taken(recipe, override):
    check_options(recipe, options(recipe, override))


def test_the_shipped_policy_is_found_from_any_folder_and_one_that_is_here_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = OmegaConf.create({"policy": "${shipped:assets/lift}", "none": "${shipped:assets/nope}"})
    assert (Path(shipped.policy) / "config.json").is_file()
    assert shipped.none == "assets/nope"
    (tmp_path / "assets" / "lift").mkdir(parents=True)
    assert shipped.policy == "assets/lift"
