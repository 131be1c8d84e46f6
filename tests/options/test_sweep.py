"""Options of sweeps: which trials run, where they are told to, and what a server is asked for."""

from tests.evaluation.synthetic import make_results
from tests.options.harness import OptionTests, Row, returning
from tests.options.seen import printed, written
from torchrl_sparse.evaluation import save_results
from torchrl_sparse.storage.json import write_json


def play(sweep, trial, lock):
    """In the place of a trial's program: its result."""
    save_results(make_results(20, names=("dense", "bac")), sweep.results_file(trial))
    sweep.finish(trial)


def trials(run):
    return run.printed.count("trial ")


def served(run):
    """Projects that a server is asked for a sweep in."""
    return [call["project"] for call in run.calls["wandb.sweep"]]


def write_sweep(path, **parameters):
    values = {name: {"values": values} for name, values in parameters.items()}
    command = ["${env}", "python", "${program}", "${args_no_hyphens}"]
    write_json(path, {"program": "trial.py", "method": "grid", "command": command, "parameters": values})


class TestOptions(OptionTests):
    recipe = "sweep"
    base = ("sweep=one.yaml", "out=sweep")
    replaced = {"run_trial": play, "wandb.sweep": returning("abc"), "wandb.agent": returning(None)}
    groups = (
        [
            Row("sweep", "two.yaml", printed(r"trial 1: (\w+)"), "seed"),
            Row("out", "elsewhere", written("elsewhere/results.json"), True),
        ],
        [Row("count", "1", trials, 1)],
        [
            Row("mode", "online", lambda run: "online" if served(run) else "offline"),
            Row("project", "mine", served, ["mine"]),
        ],
    )

    @staticmethod
    def prepare(folder):
        (folder / "trial.py").touch()
        write_sweep(folder / "one.yaml", num_updates=[1, 2])
        write_sweep(folder / "two.yaml", seed=[1, 2])
