"""Searched schedules against all chains there are, on a tiny policy; what a killed search leaves; and what is refused."""

import json
from itertools import combinations, product

import pytest
import torch

from recipes.studies.offline_errors.errors import draw_answers, offline_errors
from recipes.studies.search_schedule import schedules
from recipes.studies.search_schedule.evolution import Evolution, PrunedChain
from recipes.studies.search_schedule.schedules import Judge, compare, judged_rows, rivals
from tests.fixtures.diffusion import demos, make_network  # noqa: F401
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler
from torchrl_sparse.methods import make_method
from torchrl_sparse.training.diffusion.targets import make_targets

BUDGET, WEIGHTS = 1.7, torch.tensor([3.0, 1.0, 6.0])


@pytest.fixture
def policy(make_network, demos):  # noqa: F811
    """One layer and six training steps."""
    normalizer = Normalizer.fit(demos.data["observation", "state"], demos.data["action"], poses=True)
    sampler = Sampler("ddpm", 6, num_train_timesteps=6)
    return DiffusionPolicy(make_network(n_layer=1), normalizer, sampler=sampler, engine="reference")


@pytest.fixture
def judge(policy, demos):  # noqa: F811
    targets = make_targets(policy, demos, share=0.1, source="data", n_action_steps=4)
    return Judge(policy, targets, draws=2, n_action_steps=4)


@pytest.fixture
def search(judge, tmp_path):
    def run(options=Evolution(8, 10), fitness="energy_score", weights=lambda: WEIGHTS, **made_for):  # noqa: B008
        return schedules.search_schedule(
            judge,
            weights,
            tmp_path / "tried.json",
            budget=BUDGET,
            lengths=(2,),
            fitness=fitness,
            options=options,
            made_for={"task": "walks", **made_for},
        )

    return run


def all_chains():
    """Every pair of timesteps with every mask of two steps that costs no more than the budget."""
    for steps, row in product(combinations(range(6), 2), product("01", repeat=3)):
        computed = sum(weight for weight, cell in zip((0.3, 0.1, 0.6), row, strict=True) if cell == "0")
        if 1 + computed <= BUDGET:
            yield PrunedChain(steps[::-1], ("000", "".join(row)))


@pytest.mark.parametrize("fitness", ["energy_score", "error"])
def test_evolution_finds_the_best_of_all_chains(search, judge, fitness):
    by_hand = {chain: judge.scores(chain)[fitness].mean().item() for chain in all_chains()}
    space, tried = search(Evolution(16, 40), fitness)
    assert tried.items() <= by_hand.items()
    assert next(iter(tried)) == min(by_hand, key=by_hand.get)
    assert all(space.cost(chain) <= BUDGET + 1e-9 for chain in tried)


def test_fitness_is_what_offline_errors_say(judge, policy, demos):  # noqa: F811
    unpruned = policy.with_plan(None, Sampler("ddpm", None, 6, timesteps=[4, 1]))
    answers = draw_answers(unpruned, judge.targets, draws=2, n_action_steps=4)
    errors = offline_errors(answers, judge.targets["target"][:, 1:5].flatten(1), answers)
    found = judge.scores(PrunedChain((4, 1), ("000", "000")))
    assert found["error"].mean().item() == pytest.approx(errors.error)
    assert found["energy_score"].mean().item() == pytest.approx(errors.energy_score)


def test_a_killed_search_ends_as_one_that_was_not(search, monkeypatch, tmp_path):
    whole, path, asked = [*search()[1].items()], tmp_path / "tried.json", []
    path.unlink()
    note_what_is_asked(monkeypatch, asked, last=25)
    with pytest.raises(KeyboardInterrupt):
        search()
    kept = {(*one["timesteps"], *one["rows"]) for one in json.loads(path.read_text())["chains"]}
    asked.clear()

    def again(options=Evolution(8, 10)):  # noqa: B008
        return search(options, weights=lambda: pytest.fail("costs are measured once"))[1]

    note_what_is_asked(monkeypatch, asked, last=1000)
    assert [*again().items()] == whole
    assert not kept & {(*chain.timesteps, *chain.rows) for chain in asked}
    asked.clear()
    assert [*again().items()] == whole
    assert asked == []
    assert again(Evolution(8, 14)).items() >= dict(whole).items()


def note_what_is_asked(monkeypatch, asked, *, last):
    """Have `Judge.scores` write down its chains, and be interrupted by the last of them."""
    monkeypatch.undo()
    real = Judge.scores

    def scores(self, chain):
        asked.append(chain)
        if len(asked) == last:
            raise KeyboardInterrupt
        return real(self, chain)

    monkeypatch.setattr(Judge, "scores", scores)


def test_the_comparison_is_on_other_demonstrations(judge, search, policy, demos):  # noqa: F811
    space, tried = search()
    best = next(iter(tried))
    targets = make_targets(policy, demos, share=0.1, source="data", n_action_steps=4, seed=1)
    unseen = Judge(policy, targets, draws=2, n_action_steps=4, seed=1)
    chains = rivals(judge, space, best, fitness="energy_score", random_masks=3)
    assert chains["searched"] == [best]
    assert [len(chains[name][0].timesteps) for name in ("unpruned", "unpruned logsnr")] == [1, 1]
    assert len(chains["random masks"]) == 3
    judged = compare(unseen, space, chains)
    assert judged["searched"].over_searched == 0
    assert judged["searched"].energy_score == pytest.approx(unseen.scores(best)["energy_score"].mean().item())
    for name, one in judged.items():
        assert one.cost == 6 if name == "dense" else one.cost <= BUDGET + 1e-9
        gap = one.energy_score - judged["searched"].energy_score
        assert one.over_searched == pytest.approx(gap, abs=1e-5)
    assert judged_rows(judged)[0]["over searched"] == "+0.0000 ± 0.0000"


def test_the_schedule_is_a_method_by_its_name(policy, judge, tmp_path):
    chain = PrunedChain((4, 1), ("000", "101"))
    schedules.chain_schedule(policy, chain, settings={"tried": 1}).save_pretrained(tmp_path / "found.json")
    options = {"num_updates": 1, "planners": tmp_path, "calibration": None}
    made = make_method("found", policy, **options)
    assert made.sampler.timesteps.tolist() == [4, 1]
    assert made.plan.static_mask.tolist() == chain.mask().tolist()
    answers = draw_answers(made, judge.targets, draws=2, n_action_steps=4)
    assert torch.equal(answers, judge._answers(chain))


def test_what_was_made_for_something_else_or_is_damaged_is_refused(search, tmp_path):
    search()
    path = tmp_path / "tried.json"
    before = path.read_bytes()
    with refused("tried.json"):
        search(seed=1)
    assert path.read_bytes() == before
    path.write_bytes(before[: len(before) // 2])
    with refused("tried.json"):
        search()


def test_a_rule_of_reuse_is_one_of_three(judge, policy, tmp_path):
    judge.reuse = "magic"
    with refused("reuse"):
        judge.scores(PrunedChain((4, 1), ("000", "101")))
