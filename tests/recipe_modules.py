"""Recipes as modules, to test their parts in this process, and as programs."""

import importlib.util
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from tests.forked import FORKED

RECIPES = Path(__file__).parents[1] / "recipes"
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "WANDB_MODE": "offline", "WANDB_SILENT": "true"}


def script(recipe):
    """Return the program of a recipe, or of a study named ``studies.NAME``."""
    if str(recipe).startswith("studies."):
        return RECIPES / "studies" / recipe.removeprefix("studies.") / "__main__.py"
    return RECIPES / f"{recipe}.py"


def options_file(recipe):
    """Return the yaml of its options."""
    return script(recipe).with_name(f"{recipe.removeprefix('studies.')}.yaml")


def load_recipe(name):
    spec = importlib.util.spec_from_file_location(name, script(name))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(recipe, *options, expect=0):
    """Run a recipe as a program, and return what it printed; in a process that has imported before what recipes import."""
    with tempfile.TemporaryDirectory() as folder:
        printed = [Path(folder, name) for name in ("stdout", "stderr")]
        process = started(recipe, *options, printed=printed)
        process.join()
        return _checked(process.exitcode, "".join(path.read_text() for path in printed), expect)


def started(recipe, *options, printed=(os.devnull, os.devnull)):
    """Start a recipe as such a process and return that; what it prints goes into the two files."""
    process = FORKED.Process(target=_play, args=(recipe, options, printed))
    process.start()
    return process


def run_alone(recipe, *options, expect=0, environment=ENVIRONMENT):
    """The same in an interpreter of its own."""
    path = script(recipe)
    program = [str(path)] if path.parent == RECIPES else ["-m", f"recipes.{recipe}"]
    command = [sys.executable, *program, *options]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    return _checked(done.returncode, done.stdout + done.stderr, expect)


def _play(recipe, options, printed):
    for descriptor, path in enumerate(printed, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), descriptor)
    os.environ.update(ENVIRONMENT)
    multiprocessing.set_start_method(None, force=True)  # not that of the server
    torch.set_num_threads(1)
    path = str(script(recipe))
    sys.argv = [path, *options]
    sys.path[:0] = [str(RECIPES), str(RECIPES.parent)]
    runpy.run_path(path, run_name="__main__")


def _checked(code, printed, expect):
    assert expect is None or code == expect, printed[-3000:]
    return printed
