import numpy as np
import pytest
from matplotlib.axes import Axes

from tests.evaluation.figures.test_plots import has_color, read
from tests.refusals import refused
from torchrl_sparse.evaluation.figures.colors import method_colors
from torchrl_sparse.evaluation.figures.tokens import (
    _QUERY,
    draw_tokens,
    plot_control,
    plot_token_budgets,
    plot_token_strip,
    plot_tokens_per_layer,
)
from torchrl_sparse.methods.token_budget import BudgetPoint, TokenBudget

IMAGES = np.random.default_rng(0).integers(0, 256, (2, 3, 24, 24), np.uint8)


def test_tokens_that_were_kept_look_as_they_are_and_others_are_darkened_in_their_place():
    depth = np.full(32, 6)
    depth[[5, 16 + 11]] = (
        0,
        3,
    )  # second row, second column of the first camera; third row, last column of the other
    picture = draw_tokens(IMAGES, depth, num_layers=6)
    original = np.concatenate(np.moveaxis(IMAGES, 1, -1), axis=1)
    changed = (picture != original).any(-1)
    expected = np.zeros((24, 48), bool)
    expected[6:12, 6:12] = expected[12:18, 42:48] = True
    assert not changed[~expected].any()
    assert changed[expected].mean() > 0.9
    dark, half = picture[6:12, 6:12].mean(), picture[12:18, 42:48].mean()
    assert dark < half < original.mean()


def test_pictures_are_scaled_by_whole_pixels():
    picture = draw_tokens(IMAGES, np.full(32, 6), num_layers=6, scale=3)
    assert np.array_equal(picture[::3, ::3], draw_tokens(IMAGES, np.full(32, 6), num_layers=6))
    assert picture.shape == (72, 144, 3)


@pytest.mark.parametrize("tokens", [31, 18, 50])
def test_tokens_that_do_not_fit_the_images_are_named(tokens):
    if tokens == 18:
        assert draw_tokens(IMAGES, np.ones(18), 1).shape == (24, 48, 3)  # 3 x 3 divide 24
    else:
        with refused("depth"):
            draw_tokens(IMAGES, np.ones(tokens), 1)


def test_strip(tmp_path):
    pictures = [draw_tokens(IMAGES, np.arange(32) % 7, 6, scale=4)] * 5
    path = plot_token_strip(pictures, [f"step {8 * i}" for i in range(5)], tmp_path / "strip.png")
    assert read(path).shape[1] == 900
    with refused("pictures"):
        plot_token_strip(pictures, ["one"], tmp_path / "strip.png")


def test_control_timeline_shows_fine_mode_only_where_there_is_some(tmp_path):
    steps = np.arange(40)
    speed, fine, queried = np.exp(-steps / 9), steps > 25, steps % 8 == 0
    kept = np.where(fine, 40.0, 20.0)
    read(plot_control(speed, fine, queried, tmp_path / "a.png", kept=kept))
    with_fine, without = (
        read(plot_control(speed, mode, queried, tmp_path / "b.png")) for mode in (fine, ~fine & fine)
    )
    assert has_color(with_fine, _QUERY)
    yellow = [
        (np.ptp(pixels.astype(int), axis=-1) > 30) & (pixels[..., 2] < 215) for pixels in (with_fine, without)
    ]
    assert yellow[0].sum() > yellow[1].sum() + 5000
    with refused("kept"):
        plot_control(speed, fine, queried, tmp_path / "c.png", kept=kept[:3])


def test_tokens_per_layer(tmp_path):
    depth = {"dense": np.full((3, 32), 8), "pruned": np.tile(np.arange(32) % 8 + 1, (3, 1))}
    read(plot_tokens_per_layer(depth, 8, tmp_path / "layers.png"))
    with refused("depth"):
        plot_tokens_per_layer({"none": np.zeros((0, 32))}, 8, tmp_path / "layers.png")


def budget(method, measure="action_error", losses=(0.1, 0.05, 0.01)):
    points = tuple(BudgetPoint(0.1 * (1 + i), 20.0 * (1 + i), loss) for i, loss in enumerate(losses))
    return TokenBudget(method, points[-1].number, measure, 0.03, points)


def test_budgets_of_several_methods_are_drawn_each_in_its_colour(tmp_path):
    budgets = [budget("specprune"), budget("frame_difference", losses=(0.2, 0.1, 0.02))]
    together = read(plot_token_budgets(budgets, tmp_path / "both.png"))
    alone = read(plot_token_budgets(budgets[:1], tmp_path / "one.png"))
    colors = method_colors(["specprune", "frame_difference"])
    assert all(has_color(together, color) for color in colors.values())
    assert has_color(alone, colors["specprune"])
    assert not has_color(alone, colors["frame_difference"])


def test_numbers_are_written_beside_two_curves_and_not_beside_more(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(Axes, "annotate", lambda self, text, *args, **kwargs: drawn.append(text))
    budgets = [budget("specprune"), budget("frame_difference"), budget("random")]
    plot_token_budgets(budgets[:2], tmp_path / "two.png")
    assert drawn == ["0.1", "0.2", "0.3"] * 2
    plot_token_budgets(budgets, tmp_path / "three.png")
    assert len(drawn) == 6


@pytest.mark.parametrize(
    ("budgets", "got"),
    [([], "no budget"), ([budget("fastv"), budget("random", "success")], "action_error, success")],
)
def test_budgets_by_different_measures_are_not_drawn_together(tmp_path, budgets, got):
    with refused("budgets"):
        plot_token_budgets(budgets, tmp_path / "no.png")
    assert not (tmp_path / "no.png").exists()
