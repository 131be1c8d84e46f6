"""Recipes as modules, to test what they are made of in this process."""

import importlib.util
from pathlib import Path

RECIPES = Path(__file__).parents[1] / "recipes"


def load_recipe(name):
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
