"""Run a training recipe as a user does: stop it, run it again and, beside it, train without a break."""

import signal
import subprocess
import sys
import time

import hydra
import torch

from tests.recipe_modules import RECIPES, load_recipe
from torchrl_sparse.runtime.threads import num_threads


def stop_and_go_on(recipe, out, settings):
    """Terminate the recipe after its first checkpoint and run it again; return the step of the stop and what both printed."""
    process = _start(recipe, [*settings, f"out={out}"])
    deadline = time.monotonic() + 120
    while not (out / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    first = _finish(process)
    step = torch.load(out / "checkpoint.pt", weights_only=True)["step"]
    return step, first, _finish(_start(recipe, [*settings, f"out={out}"]))


def train_unbroken(recipe, out, settings):
    """The same training in this process, without the recipe's loop."""
    module = load_recipe(recipe)
    with hydra.initialize_config_dir(str(RECIPES), version_base=None):
        config = hydra.compose(recipe, [*settings, f"out={out}"])
    trainer = module.make_trainer(config)
    with num_threads(1):
        while trainer.step < trainer.total:
            trainer.train_step()
    module.export(trainer, config)


def _start(recipe, arguments):
    command = [sys.executable, str(RECIPES / f"{recipe}.py"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def _finish(process):
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    return output
