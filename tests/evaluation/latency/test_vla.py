"""The latency benchmark of vision-language-action models at toy size: what it runs, what it writes, what it draws."""

import pytest
import torch

pytest.importorskip("transformers")

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.evaluation.benchmarks.vla_latency import measure_vla
from torchrl_sparse.evaluation.latency.measure import describe_machine
from torchrl_sparse.evaluation.latency.vla_cases import SHAPES, VLACase, make_policy
from torchrl_sparse.networks.vla.flops import decoder_flops, fixed_flops
from torchrl_sparse.tokens import FastVPruner, FrameDifferencePruner, SpecPrune

SPEC = SHAPES["toy"].visual_spec


@pytest.fixture(scope="module")
def case():
    pruners = {
        "dense": None,
        "specprune": SpecPrune(),
        "fastv": FastVPruner(),
        "frames": FrameDifferencePruner(),
    }
    with torch.no_grad():
        return VLACase(make_policy("toy"), pruners)


def test_the_reduced_shape_has_the_published_tokens_and_about_the_published_share_of_the_decoder():
    reduced, published = SHAPES["reduced"], SHAPES["openvla_oft"]
    assert (reduced.num_visual, reduced.num_slots) == (published.num_visual, published.num_slots) == (512, 56)
    shares = []
    for config in (reduced, published):
        decoder = decoder_flops(config, torch.full((config.llm.layers,), 605)).item()
        shares.append(decoder / (decoder + sum(fixed_flops(config).values())))
    assert shares[0] == pytest.approx(shares[1], abs=0.03)


@torch.no_grad()
def test_every_method_answers_the_second_query_with_what_it_remembers_of_the_first(case):
    for name in case.policies:
        assert torch.equal(
            case.answer(name)[keys.CHUNK], case.answer(name)[keys.CHUNK]
        )  # nothing is left behind
    assert case.answer("dense")[keys.KEPT].item() == SPEC.num_visual
    assert (
        case.answer("frames")[keys.KEPT].item() == SPEC.num_visual / 2
    )  # a first policy call would keep all
    depth = case.answer("specprune")[keys.TOKEN_DEPTH][0]
    assert SPEC.num_visual > (depth > 2).sum() > (depth == SPEC.num_layers).sum() > 0


@torch.no_grad()
def test_replayed_helpers_do_what_the_query_did(case):
    recorder = case.record("specprune")
    scored = case.policies["specprune"].pruner.layers_scored(SPEC.num_layers)
    assert [state.layer for state, _ in recorder.scored] == sorted(scored)
    lengths = [state.hidden.shape[1] for state, _ in recorder.answered]
    assert lengths[0] == lengths[1] == case.sequence().hidden.shape[1]
    assert lengths[-1] < lengths[2] < lengths[1]
    keeps = [keep for _, keep in recorder.answered]
    recorder.choose()  # and the answers are the same again
    again = case.record("specprune")
    for one, (_, other) in zip(keeps, again.answered, strict=True):
        assert (one is None) == (other is None)
        assert one is None or torch.equal(one, other)
    assert set(case.helpers("specprune")) == {"choosing", "comparing", "scoring", "gathering"}
    assert set(case.helpers("fastv")) == {"choosing", "scoring", "gathering"}
    assert set(case.helpers("frames")) == {"choosing", "comparing"}


def test_numbers_are_those_of_the_medians(case):
    with torch.no_grad():
        results = measure_vla(case, name="toy", machine=describe_machine(), repeats=3, warmup=0)
    dense = results.methods["dense"]
    assert sum(part.p50_s for part in results.parts.values()) >= dense.p50_s * 0.999
    assert dense.speedup == dense.flops_speedup == dense.realised == 1
    assert dense.helper_share == 0
    for name, row in results.methods.items():
        assert row.speedup == pytest.approx(dense.p50_s / row.p50_s)
        assert row.flops_speedup == pytest.approx(dense.flops / row.flops)
        assert row.realised == pytest.approx(row.speedup / row.flops_speedup)
        assert row.helper_share == pytest.approx(sum(helper.share for helper in row.helpers.values()))
        assert sum(row.tokens_per_layer) / len(row.tokens_per_layer) == pytest.approx(row.kept)
        assert (row.flops_speedup > 1) == (name != "dense")
    # BOS, proprio and stop; the slots of two actions; the prompt, of which 17 words are the instruction's
    assert results.shape.tokens == SPEC.num_visual + 3 + 14 + (9 + 17 + 4)


def test_unknown_shapes_are_refused():
    with refused("shape"):
        make_policy("huge")
