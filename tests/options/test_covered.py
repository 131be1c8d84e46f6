"""Every recipe and every study has its table of options."""

import importlib
from pathlib import Path

from tests.options.harness import OptionTests
from tests.recipe_modules import RECIPES


def test_every_recipe_has_a_table_of_its_options():
    for path in Path(__file__).parent.glob("test_*.py"):
        importlib.import_module(f"tests.options.{path.stem}")
    covered = {tests.recipe for tests in OptionTests.__subclasses__()}
    studies = {f"studies.{path.parent.name}" for path in RECIPES.glob("studies/*/__main__.py")}
    assert covered == {path.stem for path in RECIPES.glob("*.yaml")} | studies
