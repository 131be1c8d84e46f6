"""A program is only another way of writing a mask."""

import numpy as np
import pytest

from torchrl_sparse.blocks.engine.program import (
    COLLAPSE,
    COMPUTE,
    REUSE,
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
