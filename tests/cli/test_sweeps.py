"""Sweeps without a server: what wandb's engine chooses is kept, and our yamls are wandb's."""

from pathlib import Path

import pytest
import yaml

from tests.evaluation.synthetic import make_results
from tests.refusals import refused
from torchrl_sparse.cli.sweep_files import read_sweep, trial_command
from torchrl_sparse.cli.sweeps import LocalSweep, Trial, merge_trials
from torchrl_sparse.envs.seeds import DEVELOPMENT_SEED, evaluation_seeds
from torchrl_sparse.evaluation.results.schema import save_results
from torchrl_sparse.evaluation.results.tracking import trial_metrics

SWEEPS = sorted((Path(__file__).parents[2] / "recipes" / "sweeps").glob("*.yaml"))
BAYES = {
    "program": "trial.py",
    "method": "bayes",
    "metric": {"name": "tested/success", "goal": "maximize"},
    "parameters": {"num_updates": {"min": 2, "max": 50}},
    "command": ["python", "${program}", "${args_no_hyphens}"],
}


def finish(sweep, trial):
    save_results(make_results(20, names=("dense", "bac")), sweep.results_file(trial))
    sweep.finish(trial)


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_shipped_sweeps_are_of_wandbs_schema_and_have_eight_trials_in_any_folder(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sweep = LocalSweep(read_sweep(path), tmp_path / path.stem)
    seen = set()
    while trial := sweep.next_trial():
        command = trial_command(sweep.config, trial.parameters)
        assert command[:2] == ["/usr/bin/env", "python"]
        assert Path(command[2]).is_file()
        assert not any(word.startswith("${") for word in command)
        options = dict(word.split("=", 1) for word in command if "=" in word)
        assert evaluation_seeds(options["split"], int(options["seed"]), 1)[0] == DEVELOPMENT_SEED
        seen.add(tuple(command))
        finish(sweep, trial)
    assert len(seen) == len(sweep.trials) == 8


def test_a_search_learns_from_finished_trials_and_stops_at_its_count(tmp_path):
    sweep = LocalSweep(BAYES, tmp_path, count=3)
    while trial := sweep.next_trial():
        assert 2 <= trial.parameters["num_updates"] <= 50
        finish(sweep, trial)
    assert len(LocalSweep(BAYES, tmp_path, count=3).trials) == 3
    with refused("count"):
        LocalSweep(BAYES, tmp_path)


def test_a_trial_is_on_disk_before_it_runs_and_runs_again_after_a_kill(tmp_path):
    trial = LocalSweep(BAYES, tmp_path, count=2).next_trial()
    again = LocalSweep(BAYES, tmp_path, count=2)
    assert again.next_trial() == trial
    with refused(f"trial {trial.label}", FileNotFoundError):
        again.finish(trial)


def test_another_sweep_in_the_folder_is_refused_once_a_trial_of_it_is_through(tmp_path):
    failed = LocalSweep(BAYES, tmp_path, count=2).next_trial()
    other = LocalSweep({**BAYES, "method": "random"}, tmp_path, count=2)
    trial = other.next_trial()
    assert other.trials == [trial] != [failed]
    other.results_file(trial).parent.mkdir()
    other.results_file(trial).touch()
    other.finish(trial)
    with refused("sweep.json"):
        LocalSweep(BAYES, tmp_path, count=2)


def test_what_wandb_would_refuse_is_named(tmp_path):
    for change, entry in (
        ({"method": "guess"}, "bad.yaml: method"),
        ({"program": 3}, "bad.yaml: program"),
        ({"parameters": [1]}, "bad.yaml: parameters"),
        ({"command": None}, "bad.yaml: command"),
        ({"parameters": {"n": {"value": 1, "values": [1]}}}, "bad.yaml"),
    ):
        (tmp_path / "bad.yaml").write_text(yaml.safe_dump({**BAYES, **change}))
        with refused(entry):
            read_sweep(tmp_path / "bad.yaml")


@pytest.mark.parametrize(
    "change",
    [
        {"command": ["${program}", "${args_no_hyphens}", "split=test"]},
        {"parameters": {"split": {"values": ["development", "test"]}}},
        {"parameters": {"split": {"value": "test"}}},
    ],
)
def test_a_sweep_on_test_seeds_is_refused(tmp_path, change):
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump({**BAYES, **change}))
    with refused("bad.yaml: split"):
        read_sweep(tmp_path / "bad.yaml")


def test_metrics_have_names_that_do_not_depend_on_the_method():
    results = make_results(20, names=("dense", "ddim10"))
    metrics = trial_metrics(results)
    rate = results.methods["ddim10"].success.rate
    assert metrics["tested/success"] == metrics["ddim10/success"] == rate
    assert metrics["dense/speedup"] == 1


def test_trials_go_by_what_they_tested_or_else_by_their_parameters():
    def merged(*tested):
        pairs = [
            (Trial(str(i), {"seed": i}), make_results(20, names=("dense", name)))
            for i, name in enumerate(tested)
        ]
        return list(merge_trials(pairs).methods)

    assert merged("ddim10", "bac") == ["dense", "ddim10", "bac"]
    assert merged("bac", "bac") == ["dense", "seed=0", "seed=1"]
    assert merged("dense", "bac") == ["dense", "seed=0", "seed=1"]


def test_nothing_finished_cannot_be_merged():
    with refused("trials"):
        merge_trials([])
