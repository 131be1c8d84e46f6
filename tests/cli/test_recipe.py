"""Whatever is wrong with a recipe's options is one line on stderr and exit code 2, and leaves nothing behind."""

import os
import sys

import pytest
import yaml

from tests.recipe_modules import RECIPES, load_recipe, run
from tests.refusals import refused
from torchrl_sparse.runtime.lock import lock_output


@pytest.fixture
def fail(monkeypatch, capsys):
    """Runs a recipe that has to fail, and returns the line that it leaves."""

    def fail(recipe, *options):
        monkeypatch.setattr(sys, "argv", [f"{recipe}.py", *map(str, options)])
        with pytest.raises(SystemExit) as ended:
            load_recipe(recipe).main()
        assert ended.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return fail


@pytest.mark.parametrize(
    ("recipe", "options", "message"),
    [
        ("benchmark", ["episodes=abc"], "episodes: expected a valid integer, got 'abc'"),
        ("benchmark", ["episodez=3"], "episodez: expected an option of this recipe, such as episodes"),
        ("benchmark", ["train.lr=3"], "train: expected an option of this recipe"),
        ("benchmark", ["episodes"], "Error parsing override 'episodes' missing EQUAL"),
        ("benchmark", ["task=juggle"], "task: expected one of Lift, "),
        ("benchmark", ["methods=[dense,magic]"], "methods: expected dense, "),
        ("benchmark", ["videos=[nope]"], "videos: expected dense, "),
        ("benchmark", ["pairs=[[dense,nope]]"], "pairs: expected two of dense, "),
        ("benchmark", ["engine=steam"], "engine: expected one of"),
        ("benchmark", ["task=can", "policy=assets/lift"], "policy: expected one of 23 observed numbers"),
        (
            "benchmark",
            ["policy=lerobot/diffusion_pusht"],
            "policy: expected a folder that holds config.json, or a .ckpt file, got lerobot/diffusion_pusht; names of",
        ),
        ("collect_demos", ["task=kitchen"], "task: expected one with an expert"),
        (
            "collect_demos",
            ["quality=nope"],
            "quality: expected one of proficient, recovering, mixed for Lift, got 'nope'",
        ),
        ("convert_demos", ["demos=nope.h5"], "nope.h5: expected a file of demonstrations, got none"),
        ("sweep", ["sweep=nope"], "sweep: expected one of bac_lift, "),
        (
            "benchmark_vla",
            ["policy=nope/vla"],
            "policy: expected a folder that holds config.json, or a .ckpt",
        ),
        (
            "benchmark_vla",
            ["policy=assets/lift"],
            "assets/lift/config.json: format: expected 'torchrl_sparse.vla",
        ),
        ("calibrate_bac", ["policy=assets/can"], "policy: expected one of 19 observed numbers"),
        ("calibrate_bac", ["task=juggle"], "task: expected one of Lift, "),
        ("evaluate_policy", ["task=juggle"], "task: expected one of Lift, "),
        ("evaluate_policy", ["policy=assets/can"], "policy: expected one of 19 observed numbers"),
        ("train_pruner", ["init=nope.json"], "expected a file nope.json, got none"),
        ("train_pruner", ["method=l2c", "spread=1"], "spread: expected null with an init or with method=l2c"),
        ("profile_policy", ["device=abacus"], "device: expected one that this machine and PyTorch have"),
        ("train_policy", ["device=cuda:99"], "device: expected one that this machine and PyTorch have"),
        ("train_policy", ["demos=nope.h5"], "nope.h5: expected a file of demonstrations, got none"),
        ("train_pruner", ["method=nope"], "method: expected one of sag, l2c, got 'nope'"),
    ],
)
def test_a_mistake_is_one_line_and_nothing_is_written(fail, tmp_path, recipe, options, message):
    assert fail(recipe, *options, f"out={tmp_path}/new/out").startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_an_option_that_has_to_be_given_is_named(fail):
    assert fail("convert_demos", "out=a.h5").startswith("demos: expected a value, got ")


@pytest.mark.parametrize(
    ("recipe", "name", "guess"),
    [
        ("benchmark", "bac_blokwise", "bac_blockwise"),
        ("benchmark", "dim10", "ddim10"),
        ("benchmark", "sag_fixd", "sag_fixed"),  # saved beside the policy
        ("benchmark_vla", "specprun", "specprune"),
    ],
)
def test_a_misspelt_method_is_told_which_is_meant(fail, tmp_path, recipe, name, guess):
    line = fail(recipe, f"methods=[{name}]", f"out={tmp_path}/out")
    assert line.startswith("methods: expected ")
    assert line.endswith(f"got '{name}', did you mean {guess}?")


@pytest.mark.parametrize(
    "content",
    ["parameters: [", "parameters: {a: {}}", "a: 1\n\tb: 2", 'a: "b\nc: {d', "7", "- " * 5000, "a: \udcff"],
)
def test_a_damaged_sweep_is_named(fail, tmp_path, content):
    path = tmp_path / "mine.yaml"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    assert fail("sweep", f"sweep={path}", f"out={tmp_path}/out").startswith(f"{path}: ")
    assert [file.name for file in tmp_path.iterdir()] == ["mine.yaml"]


def test_the_second_on_one_output_is_told_who_the_first_is(fail, tmp_path):
    options = {
        "collect_demos": "a.h5",
        "train_policy": "a",
        "benchmark": "a",
        "train_pruner": "a",
        "sweep": "a",
    }
    for recipe, name in options.items():
        with lock_output(tmp_path / name, is_file=name.endswith(".h5")):
            before = sorted(tmp_path.rglob("*"))
            line = fail(recipe, f"out={tmp_path / name}")
            assert sorted(tmp_path.rglob("*")) == before
        told = f"out: {tmp_path / name} is locked by process {os.getpid()} on "
        assert line.startswith(told)


def asks_policies(path):
    """True for the recipes that are about a policy; not where it is optional, or only the native engine is timed."""
    options = yaml.safe_load(path.read_text())
    return options.get("policy") is not None and options.get("engine") != "native"


@pytest.mark.parametrize(
    "recipe", [path.stem for path in sorted(RECIPES.glob("*.yaml")) if asks_policies(path)]
)
def test_every_recipe_that_asks_a_policy_takes_a_device_and_refuses_a_missing_one(fail, tmp_path, recipe):
    out = (
        ()
        if "out" not in yaml.safe_load((RECIPES / f"{recipe}.yaml").read_text())
        else (f"out={tmp_path}/out",)
    )
    line = fail(recipe, "device=abacus", *out)
    assert line.startswith("device: expected one that this machine and PyTorch have, got 'abacus'")
    assert not any(tmp_path.iterdir())


def test_a_sweep_on_a_server_is_taken_up_by_itself_alone(fail, monkeypatch, tmp_path):
    created, joined = [], []
    monkeypatch.setattr("wandb.sweep", lambda settings, project, entity: created.append(settings) or "id1")
    monkeypatch.setattr("wandb.agent", lambda sweep_id, **_: joined.append(sweep_id))
    options = "mode=online", f"out={tmp_path}/out"
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", ["sweep.py", "sweep=ddim_lift", *options])
        load_recipe("sweep").main()
    assert len(created) == 1
    assert joined == ["id1", "id1"]
    line = fail("sweep", "sweep=bac_lift", *options)
    assert line.startswith(f"out: {tmp_path}/out/sweep.json is of another sweep: sweep.")
    assert len(joined) == 2


def test_the_whole_traceback_can_be_had(monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "margin=2"])
    with refused("margin"):
        load_recipe("benchmark").main()


RECIPE = """
from pathlib import Path

from torchrl_sparse.cli.recipe import recipe
from torchrl_sparse.runtime.failure import RunFailed


@recipe("toy")
def main(config):
    if config.title == "disk":
        raise OSError(28, "no space left on the volume /data", "results.json")
    if config.title == "worker":
        raise ValueError("seed: expected 1,\\n   got 2\\n\\nWorker traceback: ...")
    if config.title == "expert":
        raise RunFailed("the expert fails: 0 of 20")
    if config.title == "torch":
        raise RuntimeError("mat1 and mat2")
    if config.title == "bug":
        raise AssertionError("a bug")
    Path(config.out, "made").touch()


main()
"""


QUIET = (
    "defaults: [{override hydra/job_logging: disabled}, {override hydra/hydra_logging: disabled}, _self_]\n"
)


def test_a_program_says_its_mistakes_and_keeps_its_bugs(tmp_path):
    (tmp_path / "toy.py").write_text(RECIPE)
    (tmp_path / "toy.yaml").write_text(
        QUIET + "title: ok\nout: ???\nhydra: {run: {dir: .}, output_subdir: null}\n"
    )
    toy, out = tmp_path / "toy", f"out={tmp_path}/out"
    assert run(toy, out, "title=disk", expect=2) == "results.json: no space left on the volume /data\n"
    assert run(toy, out, "title=worker", expect=2) == "seed: expected 1, got 2\n"
    assert run(toy, out, "title=expert", expect=2) == "the expert fails: 0 of 20\n"
    assert "Traceback" in run(toy, out, "title=torch", expect=1)
    assert "AssertionError: a bug" in run(toy, out, "title=bug", expect=1)
    assert not (tmp_path / "out").exists()
    assert run(toy, out) == ""
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["made"]
    assert run(toy, "--help").endswith("title: ok\nout: ???\n")


def test_help_says_what_a_recipe_is_for_and_what_its_options_do():
    told = run("calibrate_bac", "--help")
    assert told.startswith("Compute the BAC schedules of a policy, without training.\n")
    assert "samples: 1                                   # policy calls to average over" in told
    assert "hydra" not in told
