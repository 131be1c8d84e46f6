from itertools import combinations

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.blocks.bac import (
    BAC,
    SCHEDULES,
    acs,
    bac_blockwise_schedule,
    bac_schedule,
    bac_unified_schedule,
    bubbling_union,
    upstream_blocks,
)
from torchrl_sparse.blocks.calibration import Calibration
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.schedule import CacheSchedule


def random_similarity(num_steps, seed):
    return torch.rand(
        num_steps, num_steps, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def anchored(similarity, updates):
    """Sum over all steps of the similarity to the update that they reuse."""
    return sum(similarity[max(u for u in updates if u <= t), t].item() for t in range(len(similarity)))


def consecutive(similarity, updates):
    """Sum over the reused steps of the similarity to the step before."""
    return sum(similarity[t - 1, t].item() for t in range(len(similarity)) if t not in updates)


def candidates(num_steps, num_updates):
    return [(0, *rest) for rest in combinations(range(1, num_steps), num_updates - 1)]


def calibration(num_layers=3, num_steps=12, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (3 * num_layers, num_steps, num_steps)
    return Calibration(
        torch.rand(shape, generator=generator, dtype=torch.float64),
        torch.rand(3 * num_layers, generator=generator, dtype=torch.float64),
        num_samples=1,
    )


@pytest.mark.parametrize(("objective", "value"), [("anchor", anchored), ("consecutive", consecutive)])
@pytest.mark.parametrize("num_steps", range(1, 13))
def test_acs_equals_brute_force(num_steps, objective, value):
    similarity = random_similarity(num_steps, seed=num_steps)
    for num_updates in range(1, num_steps + 1):
        best = max(candidates(num_steps, num_updates), key=lambda updates: value(similarity, updates))
        assert acs(similarity, num_updates, objective) == best


@pytest.mark.parametrize("objective", ["anchor", "consecutive"])
@pytest.mark.parametrize("seed", range(20))
def test_acs_equals_brute_force_on_many_matrices_with_negative_entries(objective, seed):
    similarity = 2 * random_similarity(9, seed) - 1
    value = {"anchor": anchored, "consecutive": consecutive}[objective]
    for num_updates in (2, 4, 7):
        best = max(candidates(9, num_updates), key=lambda updates: value(similarity, updates))
        assert acs(similarity, num_updates, objective) == best


def loops(similarity, num_updates):
    """The programme as it is written on paper, taking the first strict maximum."""
    num_steps = len(similarity)
    best = [[float("-inf")] * num_steps for _ in range(num_updates + 1)]
    start = [[0] * num_steps for _ in range(num_updates + 1)]
    best[1] = similarity[0].cumsum(0).tolist()
    for m in range(2, num_updates + 1):
        for i in range(m - 1, num_steps):
            for j in range(i):
                value = best[m - 1][j] + similarity[j + 1, j + 1 : i + 1].sum().item()
                if value > best[m][i]:
                    best[m][i], start[m][i] = value, j + 1
    updates, end = [], num_steps - 1
    for m in range(num_updates, 1, -1):
        updates.append(start[m][end])
        end = start[m][end] - 1
    return (0, *reversed(updates))


@pytest.mark.parametrize("seed", range(10))
def test_the_first_of_equal_maxima_wins(seed):
    generator = torch.Generator().manual_seed(seed)
    ties = torch.randint(0, 2, (30, 30), generator=generator).double()
    for num_updates in (2, 5, 13, 30):
        assert acs(ties, num_updates) == loops(ties, num_updates)


def test_ties_everywhere_put_the_updates_first():
    assert acs(torch.ones(100, 100), 10) == tuple(range(10))
    assert acs(torch.ones(100, 100), 10, "consecutive") == tuple(range(10))


def test_schedules_differ_in_value_so_that_acs_is_not_decided_by_ties_alone():
    """The recursion as printed gives every schedule that ends at the same step the same value."""
    similarity = random_similarity(10, seed=3)
    for value in (anchored, consecutive):
        assert len({round(value(similarity, updates), 9) for updates in candidates(10, 4)}) == 84
    with refused("objective"):
        acs(similarity, 4, "telescoping")


def test_acs_finds_the_phases_of_a_block():
    similarity = torch.zeros(12, 12)
    for phase in (slice(0, 2), slice(2, 9), slice(9, 12)):
        similarity[phase, phase] = 1
    assert acs(similarity, 3) == (0, 2, 9)
    assert acs(similarity, 3, "consecutive") == (0, 2, 9)


@pytest.mark.parametrize(
    ("similarity", "num_updates", "entry"),
    [
        (torch.ones(4, 5), 2, "similarity"),
        (torch.ones(3, 4, 4), 2, "similarity"),
        (torch.full((4, 4), torch.nan), 2, "similarity"),
        (torch.ones(4, 4), 0, "num_updates"),
        (torch.ones(4, 4), 5, "num_updates"),
    ],
)
def test_acs_refuses_wrong_input(similarity, num_updates, entry):
    with refused(entry):
        acs(similarity, num_updates)


def test_bubbling_union_by_hand():
    schedules = [
        [0, 1], [0, 2], [0, 3],
        [0, 4], [0, 5], [0, 6],
        [0, 7], [0, 8], [0, 9],
    ]  # fmt: skip
    # U = {layer 0 CA, layer 1 SA, layer 1 FFN}
    errors = [0.1, 9.0, 0.2, 8.0, 0.3, 7.0, 0.1, 0.1, 0.1]
    merged = bubbling_union(schedules, errors, top_k=3)
    assert merged == (
        (0, 1), (0, 2, 3, 6, 9), (0, 3),
        (0, 4, 6, 9), (0, 5), (0, 6, 9),
        (0, 7), (0, 8), (0, 9),
    )  # fmt: skip
    assert bubbling_union(schedules, errors, top_k=1)[1] == (0, 2, 3, 6, 9)
    assert bubbling_union(schedules, errors, top_k=0) == tuple(map(tuple, schedules))


@pytest.mark.parametrize("top_k", [0, 1, 2, 5, 12])
@pytest.mark.parametrize("seed", range(5))
def test_after_bua_selected_blocks_contain_every_downstream_ffn(seed, top_k):
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(12, 20, generator=generator) < 0.3
    mask[:, 0] = True
    before = [row.nonzero().flatten().tolist() for row in mask]
    errors = torch.rand(12, generator=generator)
    after = bubbling_union(before, errors, top_k)
    upstream = upstream_blocks(errors, top_k)
    assert len(upstream) == top_k
    for block in range(12):
        assert list(after[block]) == sorted(after[block])
        if block not in upstream:
            assert after[block] == tuple(before[block])
            continue
        downstream = [ffn for ffn in range(2, 12, 3) if ffn // 3 >= block // 3]
        for ffn in downstream:
            assert set(after[block]) >= set(after[ffn])
        assert set(after[block]) == set(before[block]).union(*(before[ffn] for ffn in downstream))


def test_upstream_blocks_are_the_highest_scores_and_the_shallower_of_equals():
    assert upstream_blocks([1.0, 3.0, 2.0, 3.0, 2.0, 0.0], 3) == (1, 2, 3)


@pytest.mark.parametrize(
    ("errors", "top_k", "entry"),
    [
        ([1.0, 2.0], 1, "errors"),
        ([1.0, float("nan"), 2.0], 1, "errors"),
        ([1.0, 2.0, 3.0], 4, "top_k"),
        ([1.0, 2.0, 3.0], -1, "top_k"),
    ],
)
def test_bua_is_never_skipped_silently(errors, top_k, entry):
    with refused(entry):
        bubbling_union([[0], [0], [0]], errors, top_k)


def test_each_block_follows_its_own_acs_and_the_last_step():
    data = calibration()
    schedule = bac_blockwise_schedule(data, 4, policy="p")
    for block, steps in enumerate(schedule.computed_steps):
        assert set(steps) == {*acs(data.similarity[block], 4), 11}
    bare = bac_blockwise_schedule(data, 4, policy="p", force_last=False, objective="consecutive")
    for block, steps in enumerate(bare.computed_steps):
        assert steps == acs(data.similarity[block], 4, "consecutive")


def test_the_unified_schedule_is_one_for_all_blocks_from_their_mean_similarity():
    data = calibration()
    schedule = bac_unified_schedule(data, 4, policy="p", force_last=False)
    assert set(schedule.computed_steps) == {acs(data.similarity.mean(dim=0), 4)}


def test_bac_is_the_blockwise_schedule_after_bua():
    data = calibration()
    blockwise, bac = (make(data, 4, policy="p") for make in (bac_blockwise_schedule, bac_schedule))
    assert bac.computed_steps == bubbling_union(blockwise.computed_steps, data.errors, top_k=5)
    assert bac.computed_steps != blockwise.computed_steps
    assert bac_schedule(data, 4, policy="p", top_k=0).computed_steps == blockwise.computed_steps
    assert bac.settings["num_updates"] == 4
    assert len(bac.settings["upstream_blocks"]) == 5


@pytest.mark.parametrize("name", SCHEDULES)
def test_schedules_carry_what_they_were_made_for(name, tmp_path):
    schedule = SCHEDULES[name](calibration(), 4, policy="8d1f")
    assert (schedule.method, schedule.policy) == (name, "8d1f")
    assert (schedule.num_inference_steps, schedule.num_layers) == (12, 3)
    schedule.save_pretrained(tmp_path / "schedule.json")
    planner = BAC.from_pretrained(tmp_path / "schedule.json")
    planner.bind(PlanSpec(12, 3, "8d1f"))
    assert torch.equal(planner.mask(planner.spec), schedule.mask())


@pytest.mark.parametrize("objective", ["anchor", "consecutive"])
@pytest.mark.parametrize("name", SCHEDULES)
def test_as_many_updates_as_steps_is_exactly_dense(name, objective, network, ddpm, query):
    schedule = SCHEDULES[name](calibration(num_layers=2, num_steps=10), 10, policy="p", objective=objective)
    assert not schedule.mask().any()
    masks = schedule.mask().repeat(5, 1, 1)
    assert torch.equal(denoise(network, ddpm, *query, masks), denoise(network, ddpm, *query))


def test_fewer_updates_prune_more():
    rates = [prune_rate(bac_schedule(calibration(), m, policy="p").mask()).item() for m in (2, 5, 8, 12)]
    assert rates == sorted(rates, reverse=True)
    assert rates[0] > 0.4
    assert rates[-1] == 0


def test_a_schedule_of_another_method_is_refused():
    uniform = CacheSchedule("uniform", "p", 4, 1, ((0, 2),) * 3)
    with refused("BAC"):
        BAC(uniform)
