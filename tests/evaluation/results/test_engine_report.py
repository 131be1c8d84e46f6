"""The benchmark of the engines at toy size: what it runs, what it writes, what it draws."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.engine import TorchEngine, native_available
from torchrl_sparse.blocks.engine.eager import EagerBaseline
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.evaluation.latency.engine_cases import EngineCase, make_network
from torchrl_sparse.evaluation.latency.first_calls import first_calls
from torchrl_sparse.evaluation.latency.limits import measure_bandwidth, measure_multiply_adds
from torchrl_sparse.evaluation.latency.measure import measure_latency
from torchrl_sparse.evaluation.results.engine_report import (
    format_engine_table,
    shape_results,
)
from torchrl_sparse.networks.diffusion.sampler import Sampler

SMALL, STEPS = {"n_layer": 2, "n_emb": 32}, Sampler("ddpm", 20, 20)


@pytest.fixture(scope="module")
def case():
    return EngineCase(make_network("low_dim", **SMALL), batch=2, dense=STEPS)


def test_rows_of_a_batch_have_masks_of_their_own_at_the_rate_that_the_name_says(case):
    masks = case.queries["random91"].mask
    assert prune_rate(masks).tolist() == pytest.approx([0.91, 0.91], abs=0.005)
    assert (masks[0] != masks[1]).any()
    assert prune_rate(case.queries["ddim10-random50"].mask).tolist() == pytest.approx([0.5, 0.5], abs=0.01)
    assert case.queries["all-pruned"].mask[:, 1:].all()
    assert case.queries["ddim8"].sampler.num_inference_steps == 8


def test_a_schedule_of_bac_can_be_given():
    network = make_network("low_dim", **SMALL)
    mask = torch.zeros(20, network.num_blocks, dtype=torch.bool)
    mask[1::2, 3] = True
    case = EngineCase(network, batch=2, dense=STEPS, bac_mask=mask)
    assert torch.equal(case.queries["bac10"].mask, torch.stack([mask, mask]))


def test_every_variant_answers_its_query(case):
    variants = case.variants()
    assert {"eager dense", "eager ddim10", "reference dense", "torch dense", "torch random91"} <= set(
        variants
    )
    assert ("native bac10" in variants) == native_available()[0]
    for name, variant in variants.items():
        error = (variant.call() - case.reference(variant.kind)).abs().max()
        bound = {"native-fp16": 1e-2, "native-bf16": 1e-1, "native-int8": 1e-1}.get(name.split()[0], 1e-5)
        assert error < bound, name


def test_results_compare_with_eager_and_own_dense(case):
    variants = case.variants()
    latency = measure_latency({name: variant.call for name, variant in variants.items()}, repeats=3, warmup=1)
    shape = shape_results(case, variants, latency, threads=1)
    assert set(shape.rows) == set(variants)
    for row in shape.rows.values():
        assert row.p10_s <= row.p50_s <= row.p90_s
        assert row.n == 3
    dense, pruned = shape.rows["torch dense"], shape.rows["torch random91"]
    assert pruned.x_dense == pytest.approx(dense.p50_s / pruned.p50_s)
    assert pruned.limit_s < dense.limit_s
    # Two rows, of each of which all steps but the first are pruned by 91 % of all.
    assert pruned.f32_limit_s / dense.f32_limit_s == pytest.approx(products(case) / (20 * 2), rel=1e-6)
    native = shape.rows.get("native-bf16 dense")
    assert native is None or native.f32_limit_s is None
    table = format_engine_table("toy", shape)
    assert "| torch random91 " in table
    assert f"{1e6 * shape.all_pruned_step_s['torch']:.1f} µs in torch" in table


def products(case):
    """Dense steps of one row that have as many products as the random masks of all rows leave: one FFN is two of SA."""
    computed = (~case.queries["random91"].mask).sum(dim=(0, 1)).view(-1, 3).sum(dim=0)
    return (computed[0] + 2 * computed[2]).item() / (3 * case.network.n_layer)


def test_limits_are_rates_that_a_machine_can_have(case):
    assert 1e8 < measure_bandwidth(case.network) < 1e12
    assert 1e8 < measure_multiply_adds(size=256) < 1e13


def test_an_unknown_shape_is_refused():
    with refused("shape"):
        make_network("moon")


def test_a_variant_that_answers_otherwise_is_never_timed(case):
    variant = case.variants()["torch dense"]
    wrong = replace(variant, call=lambda: variant.call() + 1)
    assert first_calls(case, {"torch dense": variant})["torch dense"].seconds > 0
    with refused("torch dense"):
        first_calls(case, {"torch dense": wrong})


def test_the_reference_answers_each_kind_of_query_once_and_every_call_is_told(case, monkeypatch):
    answered, told = [], []
    reference = case.reference
    monkeypatch.setattr(case, "reference", lambda kind: answered.append(kind) or reference(kind))
    variants = {name: v for name, v in case.variants().items() if name in ("torch ddim2", "native ddim2")}
    first_calls(case, variants, on_call=lambda *call: told.append(call))
    assert answered == ["ddim2"]
    assert told == [(n + 1, len(variants)) for n in range(len(variants))]


def test_a_baseline_that_cannot_be_compiled_is_left_out_and_says_so(case, capsys):
    def fail():
        raise RuntimeError("no compiler\nand more")

    variant = case.variants()["torch dense"]
    broken = replace(variant, call=fail)
    found = first_calls(case, {"eager-compiled dense": broken, "torch dense": variant})
    assert list(found) == ["torch dense"]
    assert capsys.readouterr().out == "no eager-compiled dense: no compiler\n"
    with pytest.raises(RuntimeError, match="no compiler"):
        first_calls(case, {"torch dense": broken})


def test_a_peak_of_a_gpu_is_what_the_variant_took_beside_the_weights(case, monkeypatch):
    """A stand-in for the GPU's memory, of which 1000 bytes are taken: nobody is charged for what others hold."""
    calls = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: None)
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: calls.append("reset"))
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: calls.append("before") or 1000)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: calls.append("peak") or 1700)
    made = TorchEngine.__init__

    def make(engine, *args):
        calls.append("engine")
        made(engine, *args)

    monkeypatch.setattr(TorchEngine, "__init__", make)
    variants = case.variants()
    monkeypatch.setattr(case, "device", torch.device("cuda"))
    first = first_calls(case, {name: variants[name] for name in ("torch dense", "torch random91")})
    assert calls == ["reset", "before", "engine", "peak", "reset", "before", "peak"]
    weights = 4 * sum(p.numel() for p in case.network.parameters())
    assert {found.peak_bytes for found in first.values()} == {weights + 700}


@pytest.mark.parametrize(("device", "mode"), [("cpu", "default"), ("cuda", "reduce-overhead")])
def test_the_compiled_baseline_has_graphs_where_there_are_any(device, mode, monkeypatch):
    modes = []
    monkeypatch.setattr(torch, "compile", lambda function, mode: modes.append(mode))
    network = SimpleNamespace(pos_emb=SimpleNamespace(device=torch.device(device)))
    EagerBaseline(network, Sampler("ddpm", 4), compiled=True)
    assert modes == [mode]


@pytest.mark.skipif(not native_available()[0], reason=native_available()[1])
def test_every_instruction_set_can_have_rows_of_its_own():
    case = EngineCase(make_network("low_dim", **SMALL), batch=1, dense=STEPS, instruction_sets=True)
    variants = case.variants()
    for name in native_available()[1].split(", "):
        for kind in ("dense", "random91", "bac10", "ddim2"):
            variant = variants[f"native-{name} {kind}"]
            assert variant.dense == f"native-{name} dense"
            assert (variant.call() - case.reference(kind)).abs().max() < 1e-5
    widest = native_available()[1].split(", ")[-1]
    assert torch.equal(variants["native dense"].call(), variants[f"native-{widest} dense"].call())
