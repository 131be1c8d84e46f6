"""Figures of masks of a network without cross-attention."""

import numpy as np

from torchrl_sparse.evaluation.figures.masks import mask_panel, plot_mask_statistics, plot_mask_strip
from torchrl_sparse.evaluation.figures.plots import (
    block_labels,
    plot_error_surge,
    plot_schedule,
    plot_similarity,
)
from torchrl_sparse.networks.diffusion.adaln import AdaLNTransformer


def test_masks_are_drawn_with_two_blocks_a_layer(tmp_path):
    masks = np.zeros((3, 7, 4), bool)
    masks[:, 1::2, 1::2] = True
    types = AdaLNTransformer.block_types
    assert block_labels(4, types) == ["L0 SA", "L0 FFN", "L1 SA", "L1 FFN"]
    error = {"uniform": masks[0].astype(float)}
    drawn = [
        plot_schedule(masks[0], tmp_path / "a.png", name="uniform", types=types),
        plot_mask_strip(masks, tmp_path / "b.png", name="sag", steps_per_query=5, types=types),
        plot_mask_statistics(masks, tmp_path / "c.png", name="sag", types=types),
        plot_similarity(np.ones((4, 7, 7)), tmp_path / "d.png", types),
        plot_error_surge(error, {"uniform": masks[0]}, tmp_path / "e.png", types),
    ]
    assert all(path.stat().st_size > 1000 for path in drawn)
    assert mask_panel(masks[0], 70, types).shape == (70, 16, 3)
