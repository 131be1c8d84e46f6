"""A program is only another way of writing a mask."""

import time

import numpy as np
import pytest

from torchrl_sparse.blocks.engine.plan import (
    COLLAPSE,
    COMPUTE,
    REUSE,
    ProgramCache,
    build_program,
    slot_counts,
)


def random_mask(rate, steps=17, blocks=9, seed=0):
    mask = np.random.default_rng(seed).random((steps, blocks)) < rate
    mask[0] = False
    return mask


def mask_of(program, blocks):
    """The mask that a program obeys."""
    mask = np.ones((program.num_steps, blocks), bool)
    for k in range(program.num_steps):
        for op, first, _ in program.step(k):
            if op == COMPUTE:
                mask[k, first] = False
    return mask


@pytest.mark.parametrize("rate", [0, 0.1, 0.5, 0.9, 0.99, 1])
@pytest.mark.parametrize("seed", range(5))
def test_every_block_of_every_step_is_in_the_program_once_and_in_order(rate, seed):
    mask = random_mask(rate, seed=seed)
    program = build_program(mask)
    assert (mask_of(program, 9) == mask).all()
    for k in range(len(mask)):
        covered = []
        for op, first, last in program.step(k):
            covered += {COMPUTE: [first], REUSE: range(first, last), COLLAPSE: range(9)}[op]
        assert covered == list(range(9))


def test_runs_of_pruned_blocks_are_one_operation():
    mask = np.ones((2, 9), bool)
    mask[0], mask[1, 4] = False, False
    assert build_program(mask).step(1) == [(REUSE, 0, 4), (COMPUTE, 4, 0), (REUSE, 5, 9)]


def test_a_step_without_computation_collapses_and_its_sum_is_kept_until_a_block_computes():
    mask = np.ones((7, 3), bool)
    mask[0], mask[4, 1] = False, False
    steps = [build_program(mask).step(k) for k in (1, 2, 3, 5, 6)]
    assert steps == [[(COLLAPSE, fresh, 0)] for fresh in (1, 0, 0, 1, 0)]


def test_nothing_pruned_only_computes():
    program = build_program(np.zeros((4, 6), bool))
    assert program.ops[:, 0].tolist() == [COMPUTE] * 24
    assert program.starts.tolist() == [0, 6, 12, 18, 24]


@pytest.mark.parametrize("first", range(7))
@pytest.mark.parametrize("size", range(7))
@pytest.mark.parametrize("slots", [1, 3])
def test_slot_counts_counts(first, size, slots):
    read = [block % slots for block in range(first, first + size)]
    assert slot_counts(first, first + size, slots) == tuple(read.count(slot) for slot in range(slots))


def test_the_cache_keeps_the_latest_masks():
    cache = ProgramCache(capacity=2)
    first, second, third = (random_mask(0.5, seed=seed) for seed in range(3))
    kept = cache.get(first)
    cache.get(second)
    assert cache.get(first.copy()) is kept
    dropped = cache.get(second)
    cache.get(first)
    cache.get(third)
    assert len(cache) == 2
    assert cache.get(first) is kept
    assert cache.get(second) is not dropped


def test_masks_with_equal_bytes_and_different_shapes_are_different():
    cache, mask = ProgramCache(), np.zeros((4, 6), bool)
    assert cache.get(mask).num_steps == 4
    assert cache.get(mask.reshape(8, 3)).num_steps == 8


def test_a_cache_without_room_is_refused():
    with pytest.raises(ValueError, match="at least 1, got 0"):
        ProgramCache(0)


def test_a_program_is_built_in_a_fraction_of_a_query():
    """A pruned query takes about 12 ms in the fastest engine; 3 % of that are 0.36 ms."""
    mask = random_mask(0.91, 100, 24)
    seconds = []
    for _ in range(50):
        start = time.thread_time()
        build_program(mask)
        seconds.append(time.thread_time() - start)
    assert min(seconds) < 0.36e-3
