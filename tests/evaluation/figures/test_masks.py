"""Pictures of masks along a rollout: drawn at README size, and honest about what they show."""

import imageio.v3 as iio
import numpy as np
import pytest

from tests.refusals import refused
from torchrl_sparse.evaluation.figures.masks import mask_panel, plot_mask_statistics, plot_mask_strip


def random_masks(queries=20, steps=10, blocks=6):
    masks = np.random.default_rng(0).random((queries, steps, blocks)) < 0.8
    masks[:, 0] = False
    return masks


@pytest.mark.parametrize("queries", [1, 5, 20])
def test_the_strip_and_the_statistics_are_drawn(tmp_path, queries):
    strip = plot_mask_strip(random_masks(queries), tmp_path / "strip.png", name="sag", steps_per_query=8)
    statistics = plot_mask_statistics(random_masks(queries), tmp_path / "statistics.png", name="sag")
    for path in (strip, statistics):
        image = iio.imread(path)
        assert image.shape[1] == 900
        assert image.std() > 5


def test_different_masks_make_different_pictures(tmp_path):
    paths = [tmp_path / "a.png", tmp_path / "b.png"]
    for path, masks in zip(paths, (random_masks(), ~random_masks()), strict=True):
        plot_mask_strip(masks, path, name="sag", steps_per_query=8)
    assert paths[0].read_bytes() != paths[1].read_bytes()


def test_the_panel_shows_every_step_and_block():
    mask = random_masks(1)[0]
    panel = mask_panel(mask, height=40)
    assert (panel.shape, panel.dtype) == ((40, 24, 3), np.uint8)
    cells = panel[2::4, 2::4]
    assert (cells == cells[mask][0]).all(axis=-1)[mask].all()  # one colour for what is reused
    assert not (cells == cells[mask][0]).all(axis=-1)[~mask].any()
    computed = cells[0]
    assert len(np.unique(computed, axis=0)) == 3  # a colour for each type


@pytest.mark.parametrize(
    "masks", [np.zeros((0, 10, 6), bool), np.zeros((2, 10, 5), bool), np.zeros((2, 10, 6))]
)
def test_what_is_no_mask_is_refused(tmp_path, masks):
    with refused("masks"):
        plot_mask_strip(masks, tmp_path / "strip.png", name="sag", steps_per_query=8)
    assert not list(tmp_path.iterdir())
