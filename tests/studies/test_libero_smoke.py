"""The study that steps one task of each LIBERO suite, on scenes in which nothing happens."""

import hydra
import imageio.v3 as iio
import pytest
from omegaconf import OmegaConf
from torchrl.envs import Compose, InitTracker, TransformedEnv

from tests.envs.test_libero import Rendered, StillScene
from tests.recipe_modules import load_recipe, options_file
from tests.storage.published import openvla
from torchrl_sparse import keys
from torchrl_sparse.cli.options import OPTIONS, check_options
from torchrl_sparse.envs.libero import SUITES
from torchrl_sparse.envs.release_images import ReleaseImages

pytest.importorskip("transformers")
STUDY = "studies.libero_smoke"


def options(*overrides):
    with hydra.initialize_config_dir(str(options_file(STUDY).parent), version_base=None):
        return hydra.compose("libero_smoke", [*overrides])


def test_a_published_folder_is_played_on_its_images(tmp_path, monkeypatch, capsys):
    (tmp_path / "published").mkdir()
    openvla.write(tmp_path / "published", openvla.make_tensors(), *openvla.make_heads())
    recipe, asked = load_recipe(STUDY), []

    def make(suite, task_id, image_size, as_released):
        asked.append((suite, image_size, as_released))
        images = ReleaseImages([keys.IMAGE, keys.WRIST_IMAGE], image_size)
        return TransformedEnv(Rendered(256), Compose(InitTracker(), images))

    monkeypatch.setattr(recipe, "make_libero_env", make)
    played = [f"policy={tmp_path}/published", "suites=[libero_spatial]", "heads=[4,2,4]", "steps=5"]
    config = options(*played, "n_action_steps=4", "alpha=0.1", f"out={tmp_path}")
    check_options("libero_smoke", OmegaConf.to_container(config), OPTIONS | recipe.OPTIONS)
    recipe.main.__wrapped__(config)
    assert asked == [("libero_spatial", 28, True)]
    assert "libero_spatial, 'wait': 5 steps, 2 policy calls" in capsys.readouterr().out


def test_every_suite_is_stepped_and_drawn(tmp_path, monkeypatch, capsys):
    recipe = load_recipe(STUDY)
    asked = []

    def make(suite, task_id, image_size, as_released):
        assert not as_released
        asked.append((suite, task_id))
        return TransformedEnv(StillScene(image_size), InitTracker())

    monkeypatch.setattr(recipe, "make_libero_env", make)
    config = options("steps=10", "task_id=3", "n_action_steps=4", f"out={tmp_path}")
    recipe.main.__wrapped__(config)
    assert asked == [(suite, 3) for suite in SUITES]
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(SUITES)
    for suite, line in zip(SUITES, printed, strict=True):
        assert line.startswith(f"{suite}, 'wait': 10 steps, 3 policy calls")
        assert iio.imread(tmp_path / f"{suite}.png").std() > 1
