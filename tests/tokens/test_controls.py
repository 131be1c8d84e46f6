"""The variants of methods that SpecPrune is held against: a dense first call, layers that are skipped, raters as released."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.nn import functional

from tests.refusals import refused
from tests.tokens.helpers import LAYERS, Recorder, later, make_policy, query
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.hooks import TokenKind
from torchrl_sparse.tokens.dense_first import DenseFirst
from torchrl_sparse.tokens.efficientvla import (
    SIMILARITY,
    EfficientVLAPruner,
    LayerSimilarity,
    redundant_layers,
)
from torchrl_sparse.tokens.fastv import FastVPruner
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.sparsevlm import SparseVLMPruner, text_raters


def test_fastv_scales_its_layer_where_it_is_told_for_which_depth():
    depth = make_policy(FastVPruner(share=0.5, layer=16, depth=32))(query())[keys.TOKEN_DEPTH]
    assert set(depth.flatten().tolist()) == {LAYERS // 2, LAYERS}
    assert FastVPruner(depth=32).layers_scored(LAYERS) == {
        0
    }  # two of 32 are none of six, and at least one is


@pytest.mark.parametrize("make", [FastVPruner, RandomPruner, partial(SparseVLMPruner, scale=1.0)])
def test_rows_at_their_first_query_are_dense_and_the_others_as_ever(make):
    td = later(query())
    td[keys.IS_INIT][1] = True
    dense, alone = make_policy()(td.clone()), make_policy(make())(td.clone())
    both = make_policy(DenseFirst(make()))(td.clone())
    torch.testing.assert_close(both[keys.CHUNK][1], dense[keys.CHUNK][1], atol=1e-6, rtol=0)
    assert (both[keys.TOKEN_DEPTH][1] == LAYERS).all()
    for row in (0, 2):
        assert torch.equal(both[keys.TOKEN_DEPTH][row], alone[keys.TOKEN_DEPTH][row])
        torch.testing.assert_close(both[keys.CHUNK][row], alone[keys.CHUNK][row], atol=1e-5, rtol=0)
    assert not torch.equal(alone[keys.TOKEN_DEPTH][1], dense[keys.TOKEN_DEPTH][1])


def test_layers_are_skipped_for_a_whole_batch_or_not_at_all():
    with refused("inner"):
        make_policy(DenseFirst(EfficientVLAPruner(skipped=[3])))


def test_redundant_layers_are_those_that_change_their_input_least():
    outputs = []
    watched = LayerSimilarity()
    recorder = Recorder(watched)
    recorder.after_layer = lambda index, state: (
        outputs.append((state.hidden.clone(), state.alive)),
        watched.after_layer(index, state),
    )[1]
    found = make_policy(recorder)(query())[SIMILARITY]
    for row in range(3):
        for layer in range(1, LAYERS):
            (before, alive), (after, _) = outputs[layer - 1], outputs[layer]
            cosine = functional.cosine_similarity(before[row], after[row], dim=-1)[alive[row]].mean()
            assert found[row, layer].item() == pytest.approx(cosine.item(), abs=1e-5)
    mean = found.mean(0)
    best_two = sorted(range(2, LAYERS), key=lambda layer: -mean[layer])[:2]
    assert redundant_layers(found, 2) == sorted(best_two)
    assert redundant_layers(found, 4) == [2, 3, 4, 5]
    with refused("skipped"):
        redundant_layers(found, 5)


def test_raters_of_the_embeddings_are_the_same_words_in_every_layer():
    """They are those that the whole sequence's embeddings choose, whatever the layers before a scored one did."""
    pruner, embedded = SparseVLMPruner(raters="embeddings", layers=[11, 27], scale=1.0), []
    recorder = Recorder(pruner)
    recorder.before_layers = lambda state: (embedded.append(replace(state)), pruner.before_layers(state))[1]
    rated = []

    def rows(state):
        rated.append((state.layer, state.positions, pruner.score_rows(state)))
        return rated[-1][2]

    recorder.score_rows = rows
    make_policy(recorder)(query())
    start = embedded[0]
    text = start.alive & (start.kind == TokenKind.TEXT)
    chosen = text_raters(start.hidden, start.is_visual, text)
    assert [layer for layer, _, _ in rated] == [2, 5]
    for _, positions, raters in rated:
        for row in range(3):
            assert positions[row][raters[row]].tolist() == start.positions[row][chosen[row]].tolist()
    with refused("raters"):
        SparseVLMPruner(raters="words")
