"""Recipes as modules, to test their parts in this process, and as programs."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

RECIPES = Path(__file__).parents[1] / "recipes"
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "WANDB_MODE": "offline", "WANDB_SILENT": "true"}


def load_recipe(name):
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(recipe, *options, expect=0):
    command = [sys.executable, str(RECIPES / f"{recipe}.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT)
    assert expect is None or done.returncode == expect, done.stderr[-3000:]
    return done.stdout + done.stderr
