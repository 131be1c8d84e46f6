"""One call under the glass: its parts add up, its threads are compared, its tail is kept, and what cannot be is one line."""

import itertools
from functools import partial
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.blocks.engine import ENGINES, EngineEntry, native_available
from torchrl_sparse.evaluation.latency import profile
from torchrl_sparse.evaluation.latency.profile import (
    busy_cores,
    exported_call,
    paced_seconds,
    policy_inputs,
    query_parts,
    serial_share,
    tail,
    thread_seconds,
)
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer

needs_native = pytest.mark.skipif(not native_available()[0], reason=native_available()[1])
PARTS = ["query", "noise", "weights", "blocks", "compiled rest", "tensors"]


@pytest.fixture
def policy():
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        input_dim=4, output_dim=4, horizon=6, n_obs_steps=2, cond_dim=5, n_layer=2, n_emb=32
    )
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    return DiffusionPolicy(network, normalizer, sampler=Sampler("ddim", 4))


@needs_native
def test_the_parts_of_a_query_add_up_to_it(policy):
    parts = query_parts(policy, repeats=3)
    assert list(parts) == PARTS
    assert parts["query"] == pytest.approx(sum(parts[name] for name in PARTS[1:]))
    assert min(parts[name] for name in ("query", "noise", "weights", "blocks")) > 0


def test_a_query_of_another_engine_is_refused(policy):
    policy.engine = "torch"
    with refused("engine"):
        query_parts(policy, repeats=1)


@needs_native
def test_every_sampler_is_timed_on_every_number_of_threads(policy):
    samplers = {"dense": Sampler("ddpm", 6), "ddim1": Sampler("ddim", 1)}
    seconds = thread_seconds(policy.network, samplers, [1, 2], repeats=3)
    assert {name: list(counts) for name, counts in seconds.items()} == {"dense": [1, 2], "ddim1": [1, 2]}
    assert all(second > 0 for counts in seconds.values() for second in counts.values())


def test_times_are_those_of_the_sampler_and_the_threads(policy, monkeypatch):
    """Told by a stand-in for the engine, since a clock may say anything."""

    def engine(network, sampler, threads, weights="float32"):
        return SimpleNamespace(denoise=lambda noise, cond: (sampler.num_inference_steps, threads, weights))

    def measure(calls, repeats, warmup):
        return {name: SimpleNamespace(p50=call()) for name, call in calls.items()}

    for name, rounded in (("native", {}), ("native_int8", {"weights": "int8"})):
        monkeypatch.setitem(ENGINES, name, EngineEntry(partial(engine, **rounded)))
    monkeypatch.setattr(profile, "measure_latency", measure)
    samplers = {"dense": Sampler("ddpm", 6), "ddim1": Sampler("ddim", 1)}
    for name, weights in (("native", "float32"), ("native_int8", "int8")):
        seconds = thread_seconds(policy.network, samplers, [1, 2], repeats=3, engine=name)
        assert seconds == {
            name: {count: (steps, count, weights) for count in (1, 2)}
            for name, steps in (("dense", 6), ("ddim1", 1))
        }


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_serial_share_of_amdahls_law_is_found_again(share):
    assert serial_share({n: 3 * (share + (1 - share) / n) for n in (1, 2, 4)}) == pytest.approx(share)


def test_the_tail_keeps_the_latest_and_the_pace_is_kept(policy):
    with busy_cores(1):
        start = perf_counter()
        samples = paced_seconds(
            {"Python": policy}, queries=4, hz=20, inputs={"Python": policy_inputs(policy)}
        )["Python"]
    assert perf_counter() - start > 3 / 20
    assert len(samples) == 4
    assert tail(samples)["max"] == max(samples)
    assert tail([*[1.0] * 1998, 2.0, 9.0])["p99.9"] == pytest.approx(1.0, abs=0.01)


def test_callers_take_turns_evenly_in_the_period():
    order, begins = [], []

    def caller(name):
        def call():
            order.append(name)
            begins.append(perf_counter())

        return call

    samples = paced_seconds({"a": caller("a"), "b": caller("b")}, queries=3, hz=10)
    assert order[2:] == ["a", "b"] * 3  # the first two warm up
    assert all(later - earlier > 0.02 for earlier, later in itertools.pairwise(begins[2:]))
    assert {name: len(seconds) for name, seconds in samples.items()} == {"a": 3, "b": 3}


@pytest.mark.parametrize(("interrupted_at", "kept"), [(6, 2), (5, 2), (4, 1), (2, None)])
def test_an_interrupt_leaves_what_all_callers_were_timed_for(interrupted_at, kept):
    """The first two calls warm up."""
    calls = itertools.count(1)

    def caller():
        if next(calls) == 2 + interrupted_at:
            raise KeyboardInterrupt

    ask = {"a": caller, "b": caller}
    if kept is None:
        with pytest.raises(KeyboardInterrupt):
            paced_seconds(ask, queries=100, hz=None)
    else:
        samples = paced_seconds(ask, queries=100, hz=None)
        assert {name: len(seconds) for name, seconds in samples.items()} == {"a": kept, "b": kept}


@needs_native
def test_a_library_that_is_none_is_one_line(policy, tmp_path):
    (tmp_path / "libtsp.so").write_bytes(b"no library")
    for path in (tmp_path / "libtsp.so", Path("nowhere.so")):
        with refused("library"):
            exported_call(policy, path).__enter__()
