"""Valid W&B sweep files whose trials went wrong: each value arrives as it stands, or is refused by name before a trial runs."""

import json
import sys

import pytest
import yaml
from hydra import compose, initialize
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.cli.test_sweeps import finish
from tests.recipe_modules import load_recipe
from tests.refusals import refused
from torchrl_sparse.cli.sweep_files import parameter_sets, read_sweep, trial_command
from torchrl_sparse.cli.sweeps import LocalSweep, Trial
from torchrl_sparse.cli.trials import check_served, check_trials
from torchrl_sparse.runtime.failure import RunFailed
from torchrl_sparse.storage.yaml import read_yaml

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


TEXTS = [
    "null", "NULL", "true", "1e3", "nan", "12", "a,b", "a=b", "it's",
    'say "x"', "{a: null", "[a", "a]", " a ", "", "a\\", "a\\'",
    "'q'", "range(1,3)", "glob(*)", "[a],[b]", "a\nb", "#x", "é", "2026-01-01",
    "007", "0x10", "yes", "1_000", "~", "+3", "inf",
]  # fmt: skip


def test_a_text_is_the_text_that_it_is(write):
    """Source: Hydra's grammar of overrides, in which each of these unquoted is another value, several values, or an error."""
    path = write({"name": {"values": ["VALUES"]}})
    path.write_text(path.read_text().replace("values:\n    - VALUES", f"values: {json.dumps(TEXTS)}"))
    read = read_sweep(path)
    words = [trial_command(read, parameters)[3] for parameters in parameter_sets(read)]
    with initialize(version_base=None):
        arrived = [compose(overrides=[f"+{word}"]).name for word in words]
    assert arrived == TEXTS


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("[1e-4, 1e3, +1e+2]", [1e-4, 1e3, 1e2]),
        ("['1e-4', 2026-01-01]", ["1e-4", "2026-01-01"]),
    ],
)
def test_a_sweep_is_read_as_hydra_reads_yaml(write, line, values):
    """YAML 1.2 and Hydra: an exponent makes a number. PyYAML follows YAML 1.1: a text; and a date, which JSON has not."""
    path = write({"lr": {"values": ["VALUES"]}})
    path.write_text(path.read_text().replace("values:\n    - VALUES", f"values: {line}"))
    assert read_sweep(path)["parameters"]["lr"]["values"] == values


@pytest.mark.parametrize(
    ("entry", "merged"),
    [
        ("{<<: *base, a: 5}", {"a": 5, "lr": 2}),
        ("{<<: {<<: *base, a: 5, lr: 6}, b: 7}", {"a": 5, "lr": 6, "b": 7}),
        ("{<<: [{a: 8, lr: 9}, *base]}", {"a": 8, "lr": 9}),
        ("{<<: [*base, {a: 8, lr: 9, c: 3}]}", {"a": 1, "lr": 2, "c": 3}),
    ],
)
def test_merged_entries_give_way_to_own_and_earlier_ones(tmp_path, entry, merged):
    """YAML's merge keys: own entries before merged ones, earlier before later. PyYAML 6.0.4 errs where mappings share names."""
    path = tmp_path / "sweep.yaml"
    path.write_text(f"base: &base {{a: 1, lr: 2}}\nsampler: {entry}\n")
    assert read_yaml(path)["sampler"] == merged


@pytest.mark.parametrize(
    ("parameters", "entry"),
    [
        (
            {"out": {"value": "${oc.env:HOME}/a"}},
            "sweep.yaml: out",
        ),
        ({"train": {"parameters": {"lr": {"values": [1, "${lr}"]}}}}, "sweep.yaml: train.lr"),
        ({"sampler": {"value": {"true": 1}}}, "sweep.yaml: sampler"),
        (
            {"train": {"value": {"lr": 1}}, "train.lr": {"values": [1, 2]}},
            "sweep.yaml: parameters",
        ),
    ],
)
def test_a_value_that_cannot_arrive_is_refused_by_name(write, parameters, entry):
    """A reference would stand for something else; of two parameters that set one option the last would count."""
    with refused(entry):
        read_sweep(write(parameters))


@pytest.mark.parametrize(
    ("text", "entry"),
    [
        ("seed: {values: [1]}\n  seed: {values: [2]}", "sweep.yaml: line 3: seed"),
        ("seed: {value: 1, value: 2}", "sweep.yaml: line 2: value"),
        ("lr: {value: 1e400}", "sweep.yaml: parameters.lr.value"),
        ("lr: {values: [1, .nan]}", "sweep.yaml: parameters.lr.values.1"),
        ("on: {value: 1}", "sweep.yaml: parameters.True"),
        ("lr: {value: !!timestamp 2026-01-01}", "sweep.yaml: parameters.lr.value"),
        ("lr: {value: !!int ''}", "sweep.yaml"),
        ("lr: {value: &a [*a]}", "sweep.yaml"),
        ("lr: {value: &a {<<: *a}}", "sweep.yaml"),
        ("lr: {<<: 3}", "sweep.yaml: line 2: <<"),
    ],
)
def test_what_a_file_says_twice_or_cannot_mean_is_refused(tmp_path, text, entry):
    """YAML: the names of a mapping are unique. PyYAML keeps the last without a word."""
    path = tmp_path / "sweep.yaml"
    path.write_text(f"parameters:\n  {text}\n")
    with refused(entry):
        read_sweep(path)


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
    with refused("sweep.yaml: trial num_updates=0: num_updates"):
        check_trials(late, read_sweep(late))
    unknown = write({"num_upates": {"values": [10]}})
    with refused("sweep.yaml: trial num_upates=10: num_upates"):
        check_trials(unknown, read_sweep(unknown))
    drawn = write(
        {"episodes": {"distribution": "q_uniform", "min": -16, "max": 64, "q": 16}}, method="random"
    )
    with refused("sweep.yaml: trial episodes=-16: episodes"):
        check_trials(drawn, read_sweep(drawn))


def test_entries_are_honoured_or_refused_by_name(write, tmp_path):
    with refused("sweep.yaml: early_terminate"):
        read_sweep(write({"seed": {"values": [1]}}, early_terminate={"type": "hyperband", "min_iter": 3}))
    with refused("sweep.yaml: controller"):
        read_sweep(write({"seed": {"values": [1]}}, controller={"type": "local"}))
    capped = LocalSweep(read_sweep(write({"seed": {"values": [1, 2, 3]}}, run_cap=2)), tmp_path / "out")
    while trial := capped.next_trial():
        finish(capped, trial)
    assert len(capped.trials) == 2


@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        ({"command": ["python", "${program}"]}, "sweep.yaml: command"),
        (
            {"command": ["python", "benchmark.py", "${args_no_hyphens}"]},
            "sweep.yaml: command",
        ),
        ({"command": [*COMMAND, "seed=3"]}, "sweep.yaml: command"),
        ({"command": [*COMMAND, "++split=test"]}, "sweep.yaml: split"),
        (
            {"method": "bayes", "metric": {"name": "tested/success"}},
            "sweep.yaml: metric.goal",
        ),
        ({"metric": {**METRIC, "target": 0.5}}, "sweep.yaml: metric.target"),
        ({"metric": 3}, "sweep.yaml: metric"),
    ],
)
def test_a_sweep_that_would_not_do_what_it_says_is_refused(write, entries, entry):
    """Parameters that reach no trial, values that stand twice, held-out seeds, a metric that would be minimised."""
    with refused(entry):
        read_sweep(write({"seed": {"values": [1]}}, **entries))


def test_a_search_by_a_metric_that_no_trial_reports_is_refused(write, tmp_path):
    entries = {"method": "bayes", "metric": {"name": "tested/succes", "goal": "maximize"}}
    sweep = LocalSweep(
        read_sweep(write({"seed": {"min": 1, "max": 9}}, **entries)), tmp_path / "out", count=2
    )
    finish(sweep, sweep.next_trial())
    with refused("metric.name"):
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
    for value in (None, {"a": 1}, "true", "a=b", ["dense", None]):
        path = write({"horizon": {"values": [value, 60]}})
        with refused("sweep.yaml: horizon"):
            check_served(path, read_sweep(path), "torchrl_sparse")
    path = write({"horizon": {"values": [60]}}, project="mine")
    with refused("project"):
        check_served(path, read_sweep(path), "torchrl_sparse")


def test_a_trial_shows_a_traceback_where_its_user_asks_for_one(write, tmp_path, monkeypatch, capsys):
    """Hydra is to raise its errors within the sweep's own process; a trial that inherits that prints tracebacks."""
    program = tmp_path / "trial.py"
    program.write_text("import os, sys; sys.exit(int(os.environ.get('HYDRA_FULL_ERROR', 3)))")
    command = [sys.executable, "${program}", "${args_no_hyphens}"]
    path = write({"seed": {"values": [1]}}, program=str(program), command=command)
    monkeypatch.setattr(sys, "argv", ["sweep.py", f"sweep={path}", f"out={tmp_path / 'out'}"])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit):
        load_recipe("sweep").main()
    assert "trial seed=1: expected exit code 0, got 3" in capsys.readouterr().err
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(RunFailed, match="trial seed=1: expected exit code 0, got 1"):
        load_recipe("sweep").main()


def test_a_trial_is_called_by_its_parameters():
    assert Trial("a", {"horizon": None}).label == "horizon=None"
