"""What a study may be asked: its own table of options knows every default and refuses the rest."""

import hydra
import pytest
from omegaconf import OmegaConf

from tests.recipe_modules import RECIPES, load_recipe, options_file
from tests.refusals import refused
from torchrl_sparse.cli.options import OPTIONS, check_options

NAMES = sorted(path.parent.name for path in (RECIPES / "studies").glob("*/__main__.py"))


@pytest.mark.parametrize("name", NAMES)
def test_every_default_is_what_it_may_be(name):
    file = options_file(f"studies.{name}")
    with hydra.initialize_config_dir(str(file.parent), version_base=None):
        options = OmegaConf.to_container(hydra.compose(name), resolve=True)
    own = getattr(load_recipe(f"studies.{name}"), "OPTIONS", {})
    check_options(name, options, OPTIONS | own)
    assert all(f"{word.rpartition('.')[2]}:" in file.read_text() for word in own)
    with refused("nonsense"):
        check_options(name, options | {"nonsense": 1}, OPTIONS | own)
