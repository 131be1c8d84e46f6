"""Valid W&B sweep files whose trials went wrong: each value arrives as it stands, or is refused by name before a trial runs."""

import json
import os
import sys

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.evaluation.results.test_sweeps import finish
from torchrl_sparse.cli.trials import check_served, check_trials
from torchrl_sparse.evaluation.results.sweep_files import parameter_sets, read_sweep, trial_command
from torchrl_sparse.evaluation.results.sweeps import LocalSweep, Trial, run_trial
from torchrl_sparse.runtime.failure import RunFailed

COMMAND = ["${env}", "python", "${program}", "${args_no_hyphens}", "task=lift"]
METRIC = {"name": "tested/success", "goal": "maximize"}


@pytest.fixture
def write(tmp_path):
    def write_sweep(parameters, **entries):
        path = tmp_path / "sweep.yaml"
        content = {"program": "recipes/benchmark.py", "method": "grid", "metric": METRIC, "command": COMMAND}
        path.write_text(yaml.safe_dump(content | {"parameters": parameters} | entries))
        return path

    return write_sweep


@pytest.mark.parametrize(
    ("parameters", "name", "read"),
    [
        ({"horizon": {"values": [None]}}, "horizon", None),
        ({"dense_log": {"value": None}}, "dense_log", None),
        ({"methods": {"values": [["dense", "ddim10"]]}}, "methods", ["dense", "ddim10"]),
        ({"methods": {"value": "[dense,ddim10]"}}, "methods", ["dense", "ddim10"]),
        ({"train.checkpointed": {"values": [False]}}, "train.checkpointed", False),
        ({"sampler": {"value": {"kind": "ddim", "n": 10}}}, "sampler", {"kind": "ddim", "n": 10}),
        ({"sampler": {"parameters": {"kind": {"value": "ddim"}}}}, "sampler", {"kind": "ddim"}),
        ({"wandb.name": {"values": [["it's", None]]}}, "wandb.name", ["it's", None]),
        ({"train.lr": {"values": [1e-4]}}, "train.lr", 1e-4),
    ],
)
def test_a_value_arrives_as_it_stands(write, tmp_path, parameters, name, read):
    """Source: wandb/wandb#4016, #6249, #4428; wandb/sweeps#76."""
    sweep = LocalSweep(read_sweep(write(parameters)), tmp_path / "out")
    word = trial_command(sweep.config, sweep.next_trial().parameters)[3]
    (override,) = OverridesParser.create().parse_overrides([word])
    value = override.value()
    plain = {str(key): entry for key, entry in value.items()} if isinstance(value, dict) else value
    assert (override.key_or_group, json.loads(json.dumps(plain, default=str))) == (name, read)


@pytest.mark.parametrize(
    "parameter",
    [
        {"distribution": "q_uniform", "min": 16, "max": 64, "q": 16},
        {"distribution": "q_normal", "mu": 32, "sigma": 1, "q": 4},
        {"distribution": "q_log_uniform_values", "min": 4, "max": 64, "q": 4},
        {"distribution": "int_uniform", "min": 2, "max": 5},
    ],
)
def test_a_quantised_draw_is_a_plain_whole_number(write, tmp_path, parameter):
    """The engine draws numbers of numpy, which JSON refuses; a trial's parameters are stored and run."""
    config = read_sweep(write({"episodes": parameter}, method="random"))
    trial = LocalSweep(config, tmp_path / "out", count=1).next_trial()
    assert type(trial.parameters["episodes"]) is int
    assert LocalSweep(config, tmp_path / "out", count=1).next_trial() == trial
    assert all(type(few["episodes"]) is int for few in parameter_sets(config))


def test_every_trial_is_read_before_the_first(write):
    """A sweep whose last value no trial can read would fail after hours."""
    grid = write({"num_updates": {"values": [10, 5]}, "horizon": {"values": [None, 60]}})
    check_trials(grid, read_sweep(grid))
    late = write({"num_updates": {"values": [10, 5, 0]}})
    with pytest.raises(ValueError, match=r"sweep.yaml: trial num_updates=0: num_updates: expected greater"):
        check_trials(late, read_sweep(late))
    unknown = write({"num_upates": {"values": [10]}})
    with pytest.raises(
        ValueError, match=r"trial num_upates=10: num_upates: expected an option of this recipe"
    ):
        check_trials(unknown, read_sweep(unknown))
    drawn = write(
        {"episodes": {"distribution": "q_uniform", "min": -16, "max": 64, "q": 16}}, method="random"
    )
    with pytest.raises(
        ValueError, match=r"trial episodes=-16: episodes: expected greater than or equal to 1"
    ):
        check_trials(drawn, read_sweep(drawn))


def test_entries_are_honoured_or_refused_by_name(write, tmp_path):
    with pytest.raises(ValueError, match=r"sweep.yaml: early_terminate: expected no early_terminate"):
        read_sweep(write({"seed": {"values": [1]}}, early_terminate={"type": "hyperband", "min_iter": 3}))
    with pytest.raises(ValueError, match=r"sweep.yaml: controller: expected no controller"):
        read_sweep(write({"seed": {"values": [1]}}, controller={"type": "local"}))
    capped = LocalSweep(read_sweep(write({"seed": {"values": [1, 2, 3]}}, run_cap=2)), tmp_path / "out")
    while trial := capped.next_trial():
        finish(capped, trial)
    assert len(capped.trials) == 2


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"command": ["python", "${program}"]}, r"command: expected \$\{program\} and \$\{args_no_hyphens\}"),
        (
            {"command": ["python", "benchmark.py", "${args_no_hyphens}"]},
            r"command: expected \$\{program\} and",
        ),
        ({"command": [*COMMAND, "seed=3"]}, "command: expected no parameter in it, got seed"),
        ({"command": [*COMMAND, "++split=test"]}, "split: expected development, got test: a sweep tunes"),
        (
            {"method": "bayes", "metric": {"name": "tested/success"}},
            "metric.goal: expected maximize or minimize",
        ),
        ({"metric": {**METRIC, "target": 0.5}}, "metric.target: expected none"),
        ({"metric": 3}, "metric: expected a name and a goal, got 3"),
    ],
)
def test_a_sweep_that_would_not_do_what_it_says_is_refused(write, entries, message):
    """Parameters that reach no trial, values that stand twice, held-out seeds, a metric that would be minimised."""
    with pytest.raises(ValueError, match=f"sweep.yaml: {message}"):
        read_sweep(write({"seed": {"values": [1]}}, **entries))


def test_a_search_by_a_metric_that_no_trial_reports_is_refused(write, tmp_path):
    entries = {"method": "bayes", "metric": {"name": "tested/succes", "goal": "maximize"}}
    sweep = LocalSweep(
        read_sweep(write({"seed": {"min": 1, "max": 9}}, **entries)), tmp_path / "out", count=2
    )
    finish(sweep, sweep.next_trial())
    with pytest.raises(
        ValueError, match=r"metric.name: expected one of .*tested/success.*got 'tested/succes'"
    ):
        sweep.next_trial()


def test_a_file_without_a_command_gets_what_recipes_need(write, monkeypatch):
    """W&B's own default puts hyphens before options, which Hydra refuses, and gives trials no folder of their own."""
    path = write({"num_updates": {"values": [10, 5]}})
    path.write_text(path.read_text().replace("command:", "description: x\n#").replace("\n- ", "\n#"))
    config = read_sweep(path)
    monkeypatch.setenv("SWEEP_OUT", "outputs")
    check_trials(path, config)
    words = trial_command(config, {"num_updates": 5})
    assert {"num_updates=5", "split=development", "logger=wandb"} <= set(words)
    assert any(word.startswith("out=") and "WANDB_RUN_ID" in word for word in words)


def test_what_the_servers_agent_cannot_say_is_refused_online(write):
    path = write({"horizon": {"values": [None, 60]}})
    with pytest.raises(
        ValueError, match=r"sweep.yaml: horizon: expected numbers, words or lists with mode=online"
    ):
        check_served(path, read_sweep(path), "torchrl_sparse")
    path = write({"horizon": {"values": [60]}}, project="mine")
    with pytest.raises(
        ValueError, match=r"project: expected that of .*sweep.yaml, 'mine', got 'torchrl_sparse'"
    ):
        check_served(path, read_sweep(path), "torchrl_sparse")


def test_a_trial_fails_with_its_own_line(write, tmp_path, monkeypatch):
    """The sweep's process has Hydra raise its errors; a trial that inherited that would print a traceback."""
    program = tmp_path / "trial.py"
    program.write_text("import os, sys; sys.exit(os.environ.get('HYDRA_FULL_ERROR', 3))")
    path = write(
        {"seed": {"values": [1]}},
        program=str(program),
        command=[sys.executable, "${program}", "${args_no_hyphens}"],
    )
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    sweep = LocalSweep(read_sweep(path), tmp_path / "out")
    lock = os.open(os.devnull, os.O_RDONLY)
    with pytest.raises(RunFailed, match="expected exit code 0, got 3"):
        run_trial(sweep, sweep.next_trial(), lock)
    os.close(lock)
    assert Trial("a", {"horizon": None}).label == "horizon=None"
