"""The recipe of sweeps, with trials that kill it."""

import json
import signal
import subprocess
import sys
from functools import partial

import imageio.v3 as iio

from tests.evaluation.synthetic import make_results
from tests.recipe_modules import ENVIRONMENT, RECIPES, run
from torchrl_sparse.evaluation import load_results, save_results

FAKE_TRIAL = """
import os, shutil, signal, sys, time
from pathlib import Path

number = dict(word.split("=", 1) for word in sys.argv[1:])["num_updates"]
sweep = Path(os.environ["SWEEP_OUT"])
out = sweep / os.environ["WANDB_RUN_ID"]
out.mkdir(exist_ok=True)
first = not (out / "tried").exists()
(out / "tried").touch()
if number == "3" and first:  # kills the sweep and lives on
    os.kill(os.getppid(), signal.SIGKILL)
    os.close(1), os.close(2)
    deadline = time.monotonic() + 600
    while not (sweep / "go").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    (out / "ended").touch()
    sys.exit()
if number == "3" and not (out / "ended").exists():
    sys.exit("the same trial runs twice at a time")
if number == "6" and first:
    os.kill(os.getppid(), signal.SIGINT)
    time.sleep(100)
shutil.copy(Path(__file__).with_name("template.json"), out / "results.json")
"""


def test_a_sweep_of_eight_survives_a_kill_and_an_interrupt(tmp_path):
    (tmp_path / "trial.py").write_text(FAKE_TRIAL)
    save_results(make_results(20, names=("dense", "bac")), tmp_path / "template.json")
    sweep = {
        "program": str(tmp_path / "trial.py"),
        "method": "grid",
        "metric": {"name": "tested/success", "goal": "maximize"},
        "parameters": {"num_updates": {"values": list(range(1, 9))}},
        "command": ["${env}", "python", "${program}", "${args_no_hyphens}"],
    }
    (tmp_path / "toy.yaml").write_text(json.dumps(sweep))
    options = ("sweep", f"sweep={tmp_path}/toy.yaml", f"out={tmp_path}/sweep")

    def trials():
        return json.loads((tmp_path / "sweep" / "sweep.json").read_text())["trials"]

    run(*options, expect=-signal.SIGKILL)
    assert [trial["finished"] for trial in trials()] == [True, True, False]

    command = [sys.executable, str(RECIPES / "sweep.py"), *options[1:]]
    # A shell's background job ignores interrupts, and what it starts inherits that.
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT, preexec_fn=heed
    ) as again:
        assert again.stdout.readline().startswith("waiting for what process")
        (tmp_path / "sweep" / "go").touch()
        again.stdout.read()
    assert again.returncode != 0
    interrupted = trials()
    assert [trial["finished"] for trial in interrupted] == [True] * 5 + [False]

    assert "8 trials" in run(*options)
    assert [trial["id"] for trial in trials()][:6] == [trial["id"] for trial in interrupted]
    assert [trial["parameters"]["num_updates"] for trial in trials()] == list(range(1, 9))
    labels = [f"num_updates={number}" for number in range(1, 9)]
    assert list(load_results(tmp_path / "sweep" / "results.json").methods) == ["dense", *labels]
    assert len((tmp_path / "sweep" / "trials.csv").read_text().splitlines()) == 1 + 8
    assert iio.imread(tmp_path / "sweep" / "pareto.png").std() > 5
