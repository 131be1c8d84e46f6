import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.evaluation import synthetic
from tests.refusals import refused
from torchrl_sparse.evaluation.figures import labels, pareto, plots
from torchrl_sparse.evaluation.figures.colors import OTHER_COLORS
from torchrl_sparse.methods import METHODS


def read(path):
    """The picture as an array; it must be about README width and not blank."""
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert pixels.shape[1] == 900
    assert 250 < pixels.shape[0] < 900
    assert pixels.std() > 5
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 20
    return pixels


def has_color(pixels, color):
    """Whether at least 20 pixels have the colour ``#rrggbb``."""
    rgb = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return (pixels == rgb).all(axis=-1).sum() >= 20


def test_pareto(tmp_path):
    results = synthetic.make_results(100)
    path = pareto.plot_pareto(results, tmp_path / "pareto.png")
    assert os.listdir(tmp_path) == ["pareto.png"]
    pixels = read(path)
    for name in results.methods:
        assert has_color(pixels, METHODS[name].color)


def test_pareto_of_dense_alone(tmp_path):
    read(pareto.plot_pareto(synthetic.make_results(20, names=("dense",)), tmp_path / "pareto.png"))


def test_pareto_takes_unknown_methods(tmp_path, monkeypatch):
    monkeypatch.setitem(synthetic.METHODS, "mine", (0.9, 0.5, 0.5, 0.4, 0.1, 50))
    results = synthetic.make_results(20, names=("dense", "mine"))
    assert has_color(read(pareto.plot_pareto(results, tmp_path / "p.png")), OTHER_COLORS[0])


def test_labels_of_crowded_points_do_not_overlap(tmp_path, monkeypatch):
    names = ["dense", *(f"a_long_method_name_{i}" for i in range(7))]
    crowded = {name: (0.97 - 0.003 * i, 0.5, 0.2, 0.2 * 1.01**i, 0.1, 50) for i, name in enumerate(names)}
    monkeypatch.setattr(synthetic, "METHODS", {**crowded, "dense": (0.99, 0.0, 1.0, 1.0, 0.0, 50)})
    boxes = {}
    place = labels.place_labels

    def spy(figure, axes, points, *args):
        place(figure, axes, points, *args)
        renderer = figure.canvas.get_renderer()
        for text in axes.texts:
            if text.get_text() in points:
                boxes[text.get_text()] = labels.text_box(text, renderer)

    monkeypatch.setattr(pareto, "place_labels", spy)
    pareto.plot_pareto(synthetic.make_results(100, names=names), tmp_path / "pareto.png")
    assert sorted(boxes) == sorted(names)
    together = [(a, b) for a in names for b in names if a < b and boxes[a].overlaps(boxes[b])]
    assert together == []


def test_schedule_shows_the_mask_in_execution_order(tmp_path):
    mask = np.ones((10, 6), dtype=bool)
    mask[0] = False
    mask[5:, 2] = False
    path = plots.plot_schedule(mask, tmp_path / "schedule.png", name="bac", flops_ratio=0.2)
    pixels = np.asarray(Image.open(path).convert("RGB"))
    orange = (pixels == [0xD5, 0x5E, 0x00]).all(axis=-1)
    rows = np.flatnonzero(orange.sum(axis=1) > 300)
    columns = np.flatnonzero(orange[rows].all(axis=0))
    # Block 2 is the third of six rows; its orange cells are the first and the last five of ten columns.
    assert columns.min() < 200
    assert columns.max() > 850
    gap = np.flatnonzero(~orange[rows[0], columns.min() : columns.max()])
    assert 0.3 < len(gap) / (columns.max() - columns.min()) < 0.5


def test_schedule_of_the_full_policy(tmp_path):
    for name, mask in synthetic.make_masks().items():
        read(plots.plot_schedule(mask, tmp_path / f"schedule_{name}.png", name=name))
    assert len(os.listdir(tmp_path)) == 3


def test_similarity(tmp_path):
    read(plots.plot_similarity(synthetic.make_similarity(), tmp_path / "similarity.png"))
    read(plots.plot_similarity(np.ones((3, 5, 5)), tmp_path / "constant.png"))


def test_error_surge(tmp_path):
    masks = synthetic.make_masks()
    pixels = read(plots.plot_error_surge(synthetic.make_errors(), masks, tmp_path / "error_surge.png"))
    for name in masks:
        assert has_color(pixels, METHODS[name].color)


def test_block_labels():
    assert plots.block_labels(24)[-1] == "L7 FFN"


@pytest.mark.parametrize(
    ("draw", "entry"),
    [
        (lambda p: plots.plot_schedule(np.zeros((4, 6)), p, name="x"), "mask"),
        (lambda p: plots.plot_schedule(np.zeros((4, 5), bool), p, name="x"), "mask"),
        (lambda p: plots.plot_similarity(np.ones((3, 4, 5)), p), "similarity"),
        (lambda p: plots.plot_similarity(np.full((3, 4, 4), np.nan), p), "similarity"),
        (lambda p: plots.plot_error_surge({"a": np.ones((4, 6))}, {}, p), "errors and masks"),
        (
            lambda p: plots.plot_error_surge({"a": np.ones((4, 6))}, {"a": np.ones((5, 6), bool)}, p),
            "errors['a']",
        ),
    ],
)
def test_faults_leave_no_file(tmp_path, draw, entry):
    with refused(entry):
        draw(tmp_path / "figure.png")
    assert os.listdir(tmp_path) == []


def test_importing_the_evaluation_is_light():
    code = (
        "import sys, torchrl_sparse.evaluation; "
        "heavy = {'matplotlib', 'imageio', 'robosuite', 'wandb', 'transformers'} & set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
