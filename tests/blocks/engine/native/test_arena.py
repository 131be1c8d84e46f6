"""Matrices in the memory layout of the native engine."""

import torch

from torchrl_sparse.blocks.engine.native.arena import pack_panels


def test_panels_hold_the_matrix():
    weight = torch.randn(40, 300)
    parts = [part.view(2, -1, 32) for part in pack_panels(weight).split([2 * 256 * 32, 2 * 44 * 32])]
    panels = torch.cat(parts, dim=1)
    assert torch.equal(panels.transpose(1, 2).reshape(64, 300)[:40], weight)
    assert not panels[1, :, 8:].any()


def test_panels_of_bfloat16_hold_pairs_of_inputs():
    weight = torch.randn(32, 7).bfloat16()
    pairs = (
        pack_panels(weight.float(), torch.bfloat16)
        .view(4, 32)
        .contiguous()
        .view(torch.bfloat16)
        .view(4, 32, 2)
    )
    assert torch.equal(pairs.transpose(1, 2).reshape(8, 32)[:7], weight.T)
    assert not pairs[3, :, 1].any()
