"""The picture over all tasks: what is in it, on which scale, and which of two files of a task counts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from recipes.studies.fronts import figure as fronts
from tests.evaluation.figures.test_plots import has_color
from torchrl_sparse.evaluation.results.schema import load_results

LIFT, CAN, SQUARE = (
    Path("assets", task, name)
    for task, name in (
        ("lift", "results.json"),
        ("can/weaker", "results_300.json"),
        ("square/weaker", "results_150.json"),
    )
)


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn on, kept."""
    kept = []
    make = fronts.make_figure

    def keep(*args, **kwargs):
        figure, grid = make(*args, **kwargs)
        kept.append(grid)
        return figure, grid

    monkeypatch.setattr(fronts, "make_figure", keep)
    return kept


def test_each_task_has_its_methods_on_the_scales_of_all(tmp_path, drawn):
    results = [load_results(path) for path in (LIFT, SQUARE)]
    path = fronts.plot_fronts(results, tmp_path / "fronts.png")
    (grid,) = drawn
    for row in grid:
        assert len({axes.get_ylim() for axes in row}) == 1
        assert len({axes.get_xlim() for axes in row}) == 1
    for column, found in enumerate(results):
        assert grid[0][column].get_title(loc="left") == found.task
        steps = [
            f"ddpm{number}{rule}"
            for number, rule in ((10, ""), (5, "_logsnr"), (3, "_logsnr"), (2, "_logsnr"))
        ]
        (line,) = [line for line in grid[1][column].lines if line.get_color() == "#0072B2"]
        expected = [found.methods[name] for name in steps]
        assert line.get_xdata().tolist() == [method.speedup_vs_dense for method in expected]
        assert line.get_ydata().tolist() == [method.time_vs_dense.ratio for method in expected]
        assert [text.get_text() for text in grid[1][column].texts if text.get_color() == "#0072B2"] == [
            "10",
            "5",
            "3",
            "2",
        ]
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert all(has_color(pixels, color) for color in ("#0072B2", "#B2182B", "#CC79A7"))


def test_of_two_files_of_a_task_the_first_counts(tmp_path, drawn):
    lift, square = load_results(LIFT), load_results(SQUARE)
    slow = replace(lift, methods={**lift.methods, "bac": replace(lift.methods["bac"], speedup_vs_dense=1.5)})
    fronts.plot_fronts([lift, square, slow], tmp_path / "fronts.png")
    fronts.plot_fronts([slow, square, lift], tmp_path / "fronts.png")
    speeds = [
        [line.get_xdata()[0] for line in grid[0][0].lines if line.get_color() == "#B2182B"] for grid in drawn
    ]
    assert speeds == [[lift.methods["bac"].speedup_vs_dense], [1.5]]


def test_spending_is_by_what_a_second_costs_and_marked_with_the_interval(tmp_path, drawn):
    asked_often = load_results("assets/statistics/results_replanning_can.json")
    path = fronts.plot_spending([asked_often, load_results(LIFT)], tmp_path / "spending.png")
    ((upper, lower),) = drawn
    assert not [
        line for line in upper[1].lines if line.get_color() == "#0072B2"
    ]  # nothing is said of a second there
    plain, chosen = [line for line in lower[0].lines if line.get_color() == "#0072B2"]
    names = [f"ddpm3_logsnr{every}" for every in ("", "_every4", "_every2", "_every1")]
    methods = [asked_often.methods[name] for name in names]
    assert plain.get_xdata().tolist() == [method.per_episode.flops_per_step_to_dense for method in methods]
    assert plain.get_ydata().tolist() == [method.time_vs_dense.ratio for method in methods]
    assert [text.get_text() for text in lower[0].texts] == ["8", "4", "2", "1", "2"]
    assert chosen.get_xdata()[0] > 0.9
    assert has_color(np.asarray(Image.open(path).convert("RGB")), "#0072B2")


def test_one_task_is_enough(tmp_path, drawn):
    lift = load_results(LIFT)
    fronts.plot_fronts([lift, lift], tmp_path / "lift.png")
    assert drawn[0].shape == (2, 1)
