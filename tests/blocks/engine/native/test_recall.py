"""Queries that recall earlier ones, in compiled code: against the reference, in double precision."""

import pytest
import torch

from tests.blocks.engine.native.test_engine import REASON, SETS, SHAPES, make_network, make_query
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.reference import ReferenceEngine, denoise_recalling
from torchrl_sparse.networks.diffusion.sampler import Sampler

pytestmark = pytest.mark.skipif(not native_available()[0], reason=REASON)
RULES = ("block", "type", "single")


def recalling_query(network, sampler, batch=3, rate=0.7, share=0.5, seed=0):
    """A query, its mask, which pruned cells recall, and what they recall."""
    noise, cond, mask = make_query(network, sampler, batch, rate, seed)
    generator = torch.Generator().manual_seed(seed + 1)
    recalled = mask & (torch.rand(mask.shape, generator=generator) < share)
    memory = torch.randn(*mask.shape, network.horizon, network.n_emb, generator=generator)
    return noise, cond, mask, recalled, memory


def exact(network, sampler, noise, cond, mask, recalled, memory, reuse):
    network.double()
    query = noise.double(), cond.double(), mask, recalled, memory.double()
    answer = denoise_recalling(network, sampler, *query, reuse=reuse)
    network.float()
    return answer


def assert_equal(answer, expected):
    for part, exact_part in zip(answer, expected, strict=True):
        assert (part.double() - exact_part).abs().max() < 1e-5


@pytest.mark.parametrize("instruction_set", SETS)
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_reference_for_random_masks(shape, instruction_set):
    network, sampler = make_network(shape), Sampler("ddpm", 6)
    engine = NativeEngine(network, sampler, instruction_set=instruction_set)
    for seed, reuse in enumerate(RULES):
        query = recalling_query(network, sampler, seed=seed)
        assert_equal(engine.denoise_recalling(*query, reuse), exact(network, sampler, *query, reuse))


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("rate", [0.0, 0.5, 0.95, 1.1])
@pytest.mark.parametrize("name", ["ddim10", "unipc_90_50_49_10"])
def test_equals_the_reference_at_any_rate_and_share(name, rate, share):
    network, sampler = make_network(), Sampler.from_name(name)
    engine = NativeEngine(network, sampler)
    for reuse in RULES:
        query = recalling_query(network, sampler, rate=rate, share=share)
        assert_equal(engine.denoise_recalling(*query, reuse), exact(network, sampler, *query, reuse))


def test_queries_in_a_row_hand_on_what_they_computed():
    network, sampler = make_network(), Sampler("ddpm", 6)
    engine, reference = NativeEngine(network, sampler), ReferenceEngine(network, sampler)
    memory = expected_memory = recalling_query(network, sampler)[-1]
    for seed in range(4):
        query = recalling_query(network, sampler, seed=seed)[:-1]
        actions, memory = engine.denoise_recalling(*query, memory, "type")
        expected, expected_memory = reference.denoise_recalling(*query, expected_memory, "type")
        assert (actions - expected).abs().max() < 1e-5
        assert (memory - expected_memory).abs().max() < 1e-5


def test_memory_is_read_and_a_new_one_left():
    network, sampler = make_network(), Sampler("ddpm", 6)
    noise, cond, mask, recalled, memory = recalling_query(network, sampler)
    before = memory.clone()
    left = NativeEngine(network, sampler).denoise_recalling(noise, cond, mask, recalled, memory)[1]
    assert torch.equal(memory, before)
    same = (left == memory).flatten(3).all(dim=-1)
    assert torch.equal(same, mask)


@pytest.mark.parametrize("reuse", RULES)
@pytest.mark.parametrize("threads", [2, 3, 5])
def test_threads_and_batches_change_no_bit(threads, reuse):
    network, sampler = make_network(), Sampler("ddpm", 8)
    for batch in (1, 4):
        query = recalling_query(network, sampler, batch=batch, seed=batch)
        alone = NativeEngine(network, sampler, threads=1)
        expected = [
            alone.denoise_recalling(*(part[i : i + 1] for part in query), reuse) for i in range(batch)
        ]
        together = NativeEngine(network, sampler, threads=threads).denoise_recalling(*query, reuse)
        for part, rows in zip(together, zip(*expected, strict=True), strict=True):
            assert torch.equal(part, torch.cat(rows))


def test_nothing_recalled_is_the_query_without_a_memory():
    network, sampler = make_network(), Sampler("ddpm", 8)
    engine = NativeEngine(network, sampler)
    noise, cond, mask, recalled, memory = recalling_query(network, sampler, share=0.0)
    assert torch.equal(
        engine.denoise_recalling(noise, cond, mask, recalled, memory)[0], engine.denoise(noise, cond, mask)
    )


@pytest.mark.parametrize(
    ("position", "change", "message"),
    [
        (3, lambda cells: ~cells, "recall: expected pruned cells alone, got"),
        (3, lambda cells: cells[:, 1:], r"mask: expected shape \[3, 6, 6\].*got \[3, 5, 6\]"),
        (4, lambda memory: memory[..., 1:], r"memory: expected shape \[3, 6, 6, 10, 64\], got .*, 63\]"),
        (4, lambda memory: memory.double(), r"memory: expected torch.float32 .*, got torch.float64"),
    ],
)
@pytest.mark.parametrize("kind", [NativeEngine, ReferenceEngine])
def test_what_is_no_memory_is_refused(kind, position, change, message):
    network, sampler = make_network(), Sampler("ddpm", 6)
    query = list(recalling_query(network, sampler))
    query[position] = change(query[position])
    with pytest.raises(ValueError, match=message):
        kind(network, sampler).denoise_recalling(*query)
