"""SpecPrune's equations on examples worked out by hand, and the first on the decoder's own attention."""

import math

import pytest
import torch

from tests.tokens.helpers import CONFIG, LAYERS, Recorder, make_policy, query
from torchrl_sparse.networks.vla import decoder
from torchrl_sparse.tokens.specprune import (
    SpecPrune,
    confidence,
    dynamic_set,
    layer_score,
    layer_set,
    local_set,
    rank_weight,
    retain_set,
    updated_score,
)

ALIVE = torch.tensor([[True, True, False, True]])


def ids(mask):
    return mask[0].nonzero().flatten().tolist()


def test_eq_1_is_the_mean_over_heads_and_words():
    """The decoder's scores against the whole softmax of its own queries and keys."""
    caught = []
    recorder = Recorder(SpecPrune(budget=4))
    inner, run_layer = recorder.inner, decoder._run_layer

    def spy(*args):
        hidden, query_, key = run_layer(*args)
        caught.append((query_, key))
        return hidden, query_, key

    def after_layer(index, state):
        if index == 0:
            query_, key = caught[0]
            logits = query_ @ key.transpose(-1, -2) / math.sqrt(query_.shape[-1])
            weights = logits.masked_fill(~state.alive[:, None, None], -torch.inf).softmax(-1)
            for row in range(len(weights)):
                words = state.task[row] & state.alive[row]
                expected = weights[row][:, words][:, :, 1 : CONFIG.num_visual + 1].mean((0, 1))
                torch.testing.assert_close(state.scores[row], expected)
        return inner.after_layer(index, state)

    recorder.after_layer = after_layer
    policy = make_policy(recorder)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(decoder, "_run_layer", spy)
        policy(query())
    assert len(caught) == LAYERS


def test_eqs_3_to_6_choose_within_cameras_and_unite():
    counts = [torch.tensor([[1]]), torch.tensor([[2]])]
    alike = torch.tensor([[0.99, 0.2, 0.5, 0.1, 1.0, 1.0, 0.9, 1.0]])
    assert ids(dynamic_set(alike, counts, threshold=0.95)) == [
        3,
        6,
    ]  # one candidate only in the second camera
    attended = torch.tensor([[0.1, 0.9, 0.2, 0.3, 0.0, 0.4, 0.5, 0.6]])
    alive = torch.tensor([[True, False, True, True] + [True] * 4])
    first = layer_set(attended, counts, alive)
    assert ids(first) == [3, 6, 7]
    second = layer_set(-attended, counts, alive)
    assert ids(second) == [0, 4, 5]
    assert ids(local_set(first, second)) == [0, 3, 4, 5, 6, 7]
    carried = torch.zeros(1, 8).bool().index_fill(1, torch.tensor([2]), True)
    assert ids(retain_set(carried, first, second)) == [0, 2, 3, 4, 5, 6, 7]


def test_eq_8_falls_with_rank_and_sums_to_one():
    weight = rank_weight(torch.tensor([[1, 0, 3, 2]]), ALIVE, steepness=0.5)
    sigmoid = [1 / (1 + math.exp(0.5 * rank)) for rank in (1, 0, 2)]
    expected = [value / sum(sigmoid) for value in sigmoid]
    torch.testing.assert_close(weight, torch.tensor([[expected[0], expected[1], 0.0, expected[2]]]))


def test_eq_9_is_mean_over_deviation_of_the_living():
    scores = torch.tensor([[1.0, 2.0, 77.0, 3.0]])
    expected = 2.0 / (math.sqrt(2 / 3) + 1e-6)
    assert confidence(scores, ALIVE).item() == pytest.approx(expected)
    flat, peaked = torch.tensor([[1.0, 1.1, 0.0, 1.0]]), torch.tensor([[0.1, 3.0, 0.0, 0.0]])
    assert confidence(flat, ALIVE) > confidence(peaked, ALIVE)


def test_eqs_7_and_10_multiply_and_average():
    now = layer_score(torch.tensor([[0.25, 0.75]]), torch.tensor([[2.0]]))
    assert now.tolist() == [[0.5, 1.5]]
    torch.testing.assert_close(
        updated_score(torch.tensor([[1.0, 0.0]]), now, 0.2), torch.tensor([[0.9, 0.3]])
    )
