"""One query under the glass: its parts add up, its threads are compared, its tail is kept, and what cannot be is one line."""

import itertools
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace

import pytest
import torch

from recipes.studies.pages.page_rows import read_table
from tests.recipe_modules import run
from torchrl_sparse import DiffusionPolicy, Sampler
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.cli.options import check_options
from torchrl_sparse.evaluation.latency import profile
from torchrl_sparse.evaluation.latency.measure import usable_cores
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
from torchrl_sparse.evaluation.results.query_report import QueryProfile
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.storage.json import read_json

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
    with pytest.raises(ValueError, match=r"^engine: expected native, got torch$"):
        query_parts(policy, repeats=1)


@needs_native
def test_every_sampler_is_timed_on_every_number_of_threads(policy):
    samplers = {"dense": Sampler("ddpm", 6), "ddim1": Sampler("ddim", 1)}
    seconds = thread_seconds(policy.network, samplers, [1, 2], repeats=3)
    assert {name: list(counts) for name, counts in seconds.items()} == {"dense": [1, 2], "ddim1": [1, 2]}
    assert all(second > 0 for counts in seconds.values() for second in counts.values())


def test_times_are_those_of_the_sampler_and_the_threads(policy, monkeypatch):
    """Told by a stand-in for the engine, since a clock may say anything."""

    def engine(network, sampler, threads):
        return SimpleNamespace(denoise=lambda noise, cond: (sampler.num_inference_steps, threads))

    def measure(calls, repeats, warmup):
        return {name: SimpleNamespace(p50=call()) for name, call in calls.items()}

    monkeypatch.setattr(profile, "NativeEngine", engine)
    monkeypatch.setattr(profile, "measure_latency", measure)
    samplers = {"dense": Sampler("ddpm", 6), "ddim1": Sampler("ddim", 1)}
    seconds = thread_seconds(policy.network, samplers, [1, 2], repeats=3)
    assert seconds == {"dense": {1: (6, 1), 2: (6, 2)}, "ddim1": {1: (1, 1), 2: (1, 2)}}


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
def test_the_recipe_leaves_tables_and_a_figure(tmp_path, policy):
    policy.save_pretrained(tmp_path / "policy")
    options = ("queries=20", "repeats=2", "warmup=0", "thread_counts=[2]", f"out={tmp_path}/out")
    output = run("profile_query", f"policy={tmp_path}/policy", "sampler=ddim2", *options)
    assert "20 queries, one after the other." in output
    found = read_json(tmp_path / "out" / "query.json", QueryProfile)
    assert list(found.parts_s) == PARTS
    assert set(found.threads_s) == {"dense", "ddim2"}
    assert set(found.threads_s["dense"]) == {"1", "2"} if usable_cores() > 1 else {"1"}
    late = found.tails_s["Python"]
    assert late["p50"] <= late["p99.9"] <= late["max"]
    (row,) = read_table(tmp_path / "out" / "query.json", "tails").rows
    assert (row["beside"], row["queries"]) == ("0 busy processes", "20, one after the other")
    assert (tmp_path / "out" / "query_threads.png").stat().st_size > 0


@needs_native
def test_a_library_that_is_none_is_one_line(policy, tmp_path):
    (tmp_path / "libtsp.so").write_bytes(b"no library")
    for path in (tmp_path / "libtsp.so", Path("nowhere.so")):
        with pytest.raises(ValueError, match=r"^library: expected libtsp\.so, got "):
            exported_call(policy, path).__enter__()


def test_no_threads_at_all_are_refused():
    with pytest.raises(ValueError, match=r"^thread_counts.*: expected greater than or equal to 1, got 0$"):
        check_options("profile_query", {"thread_counts": [2, 0]})
