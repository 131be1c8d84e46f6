"""Chains stay within the budget, and evolution is the same whenever it is asked."""

import numpy as np
import pytest

from recipes.studies.search_schedule.evolution import ChainSpace, Evolution, PrunedChain, evolve
from tests.refusals import refused
from torchrl_sparse.networks.diffusion.spacing import timesteps_fall

WEIGHTS = [5.0, 0.1, 10.0, 4.0, 0.2, 9.0]


def wrong_cells(chain):
    """A valley: everything at 88, 41 and 7, and every second block pruned."""
    wrong = sum(cell != "01"[at % 2] for row in chain.rows[1:] for at, cell in enumerate(row))
    return wrong + sum(abs(a - b) for a, b in zip(chain.timesteps, (88, 41, 7), strict=True)) / 10


@pytest.mark.parametrize("budget", [1.05, 1.7, 2.0, 3.4])
def test_chains_keep_the_budget_compute_the_first_step_and_fall(budget):
    space, rng = ChainSpace(WEIGHTS, budget, (2, 3, 5)), np.random.default_rng(0)
    chains = [*space.starts(7, rng)]
    for _ in range(150):
        chains.append(space.child(chains[rng.integers(len(chains))], rng))
    for chain in chains:
        assert (~chain.mask() * np.array(WEIGHTS)).sum() <= budget * sum(WEIGHTS) + 1e-6
        assert set(chain.rows[0]) == {"0"}
        assert timesteps_fall(chain.timesteps, 100)
        assert len(chain.timesteps) == len(chain.rows)
        assert PrunedChain.of(chain.timesteps, chain.mask()) == chain
    assert {len(chain.timesteps) for chain in chains} == {2, 3, 5}
    assert len(set(chains)) > 100


def test_the_unpruned_chain_is_begun_with_and_widened():
    first, second, third, fourth, fifth = ChainSpace(WEIGHTS, 2.0, (2, 3)).starts(5, np.random.default_rng(0))
    assert first == third == PrunedChain((91, 41), ("0" * 6,) * 2)
    assert second == PrunedChain((91, 90, 41), ("0" * 6, "1" * 6, "0" * 6))
    assert fourth == PrunedChain((91, 41, 40), ("0" * 6, "0" * 6, "1" * 6))
    assert fifth == PrunedChain((91, 41), ("0" * 6,) * 2)


def test_a_random_chain_has_no_room_for_another_block():
    space, rng = ChainSpace(WEIGHTS, 1.7, (3,)), np.random.default_rng(0)
    for _ in range(20):
        chain = space.random(rng)
        pruned = min(
            weight for row in chain.rows for cell, weight in zip(row, WEIGHTS, strict=True) if cell == "1"
        )
        assert space.cost(chain) <= 1.7 < space.cost(chain) + pruned / sum(WEIGHTS)


def test_the_bottom_of_a_valley_is_found_and_the_same_seed_finds_the_same():
    space = ChainSpace(WEIGHTS, 2.5, (3,))
    tried = evolve(space, wrong_cells, Evolution(16, 120))
    assert min(tried.values()) == next(iter(tried.values())) == 0
    assert [*tried.items()] == [*evolve(space, wrong_cells, Evolution(16, 120)).items()]


def test_a_search_that_goes_on_asks_nothing_twice_and_ends_as_if_it_had_not_stopped():
    space, options, kept, asked = ChainSpace(WEIGHTS, 2.5, (3,)), Evolution(8, 12, seed=1), {}, []
    whole = evolve(space, wrong_cells, options)

    def dying(chain):
        if len(asked) == 63:
            raise KeyboardInterrupt
        asked.append(chain)
        return wrong_cells(chain)

    with pytest.raises(KeyboardInterrupt):
        evolve(space, dying, options, on_generation=kept.update)
    assert 0 < len(kept) < 63
    asked.clear()
    seen = []
    again = evolve(space, dying, options, known=kept, on_chain=lambda done, total: seen.append((done, total)))
    assert [*again.items()] == [*whole.items()]
    assert not set(asked) & set(kept)
    assert seen == [(done, 8 * 13) for done in range(1, 8 * 13 + 1)]


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"budget": 1.0}, "budget"),
        ({"lengths": (1,)}, "lengths"),
        ({"lengths": (101,)}, "lengths"),
        ({"lengths": ()}, "lengths"),
        ({"weights": [1.0, 0.0, 1.0]}, "weights"),
    ],
)
def test_what_is_no_space_is_refused(changes, entry):
    with refused(entry):
        ChainSpace(**{"weights": WEIGHTS, "budget": 2.0, "lengths": (3,), **changes})


@pytest.mark.parametrize("field", ["population", "generations"])
def test_nothing_is_no_search(field):
    with refused(field):
        Evolution(**{field: 0})
