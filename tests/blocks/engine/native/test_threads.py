"""Threads that share a query: the same bits, whatever their number, and no trouble for the process around them."""

import multiprocessing
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.runtime.threads import num_threads

from .test_engine import SHAPES, make_network, make_query
from .test_pruner import NativePruner, make_network as make_pruner, observations

AVAILABLE, REASON = native_available()
pytestmark = pytest.mark.skipif(not AVAILABLE, reason=REASON)
SETS = REASON.split(", ") if AVAILABLE else []


def answers(threads, shape="lift", batch=1, kind="ddpm", rate=0.7, **options):
    network, sampler = make_network(shape), Sampler(kind, 9)
    noise, cond, mask = make_query(network, sampler, batch=batch, rate=rate)
    engine = NativeEngine(network, sampler, threads=threads, **options)
    dense = engine.denoise(noise, cond)
    return torch.stack(
        [dense, *(engine.denoise(noise, cond, mask, rule) for rule in ("block", "type", "single"))]
    )


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize("shape", SHAPES)
def test_any_number_of_threads_gives_the_same_bits(shape, instruction_set):
    weights = dict(zip(SHAPES, cycle(["float32", "float16", "bfloat16"]), strict=False))[shape]
    options = {"shape": shape, "instruction_set": instruction_set, "weights": weights}
    alone = answers(1, **options)
    for threads in (2, 3, 4):
        assert torch.equal(answers(threads, **options), alone)


@pytest.mark.parametrize("rate", [0.3, 0.95, 1.1])
@pytest.mark.parametrize("kind", ["ddim", "unipc"])
def test_at_every_rate_and_with_remembered_predictions(kind, rate):
    alone = answers(1, kind=kind, rate=rate)
    assert torch.equal(answers(2, kind=kind, rate=rate), alone)
    assert torch.equal(answers(4, kind=kind, rate=rate), alone)


@pytest.mark.parametrize("batch", [2, 3, 5, 8])
def test_batches_are_split_by_rows_and_the_rest_shared(batch):
    alone = answers(1, batch=batch)
    for threads in (2, 3, 4):
        assert torch.equal(answers(threads, batch=batch), alone)


def test_a_query_of_more_threads_than_anything_can_be_split_into():
    assert torch.equal(answers(17, shape="one of each"), answers(1, shape="one of each"))


def test_the_pruner_too():
    with torch.no_grad():
        pruner, features = NativePruner(make_pruner(steps=30).mlp_weights()), observations().flatten(1)
        alone = pruner.logits(features), pruner.masks(features)
        for threads in (2, 4):
            with num_threads(threads):
                assert torch.equal(pruner.logits(features), alone[0])
                assert torch.equal(pruner.masks(features), alone[1])


def test_they_follow_torch_and_it_is_said_how_many():
    network = make_network(n_emb=96)
    engine = NativeEngine(network, Sampler("ddim", 2))
    for threads, used in ((1, "1 thread"), (2, "2 threads"), (8, "3 threads")):
        with num_threads(threads):
            assert engine.detail.endswith(f", {used}")
    assert NativeEngine(network, Sampler("ddim", 2), threads=8).detail.endswith(", 8 threads")
    for threads in (0, -1, 65, 1.5):
        with refused("threads"):
            NativeEngine(network, Sampler("ddim", 2), threads=threads)


def test_engines_and_callers_beside_each_other():
    network, sampler = make_network(), Sampler("ddpm", 20)
    query = make_query(network, sampler, batch=1)
    engines = [NativeEngine(network, sampler, threads=threads) for threads in (1, 2, 3, 4)]
    expected = engines[-1].denoise(*query)
    workers = _workers()
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda index: engines[index % 4].denoise(*query), range(40)))
    assert all(torch.equal(result, expected) for result in results)
    assert _workers() == workers  # of one team for all


def _workers():
    """Count this process' threads that block every signal."""
    status = [path.read_text() for path in Path("/proc/self/task").glob("*/status")]
    blocked = [int(text.split("SigBlk:")[1].split()[0], 16) for text in status]
    return sum(bool(mask & 1 << signal.SIGINT - 1) for mask in blocked)


def _answer_in_child(engine, query, expected, done):
    ok = torch.equal(engine.denoise(*query), expected)
    done.send(ok and torch.equal(engine.denoise(*query), expected))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_forked_child_makes_its_own_threads_also_when_forked_amid_queries():
    network, sampler = make_network(), Sampler("ddpm", 30)
    engine, query = NativeEngine(network, sampler, threads=3), make_query(network, sampler, batch=1)
    expected = engine.denoise(*query)
    context = multiprocessing.get_context("fork")
    with ThreadPoolExecutor(1) as pool:
        amid = pool.submit(lambda: [engine.denoise(*query) for _ in range(50)])
        for _ in range(4):
            here, there = context.Pipe()
            child = context.Process(target=_answer_in_child, args=(engine, query, expected, there))
            child.start()
            assert here.poll(60)
            assert here.recv()
            child.join(60)
            assert child.exitcode == 0
        assert all(torch.equal(result, expected) for result in amid.result())


def test_between_queries_they_sleep():
    network, sampler = make_network(), Sampler("ddpm", 5)
    NativeEngine(network, sampler, threads=4).denoise(*make_query(network, sampler, batch=1))
    time.sleep(0.1)
    before = time.process_time()
    time.sleep(0.3)
    assert time.process_time() - before < 0.1
