"""All stages on a small policy: what each leaves, resuming between them, the budget, and what is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from recipes.studies.pages.page_rows import read_table
from tests.evaluation.accelerate.small import GRID, HORIZON, METHODS, ask, episodes_of, fixed_times
from tests.refusals import refused
from torchrl_sparse import Sampler, Uniform
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.evaluation.accelerate import Grid, Request, candidates, run
from torchrl_sparse.evaluation.benchmarks import benchmark
from torchrl_sparse.evaluation.results.acceleration import load_acceleration
from torchrl_sparse.evaluation.results.schema import load_results
from torchrl_sparse.training.pruner.config import PrunerConfig

TIMES = fixed_times({"ddim4": 5.0})
STAGES = {
    "find_timesteps": (candidates, "planners/searches/ddpm2.json"),
    "bac_schedule": (candidates, "planners/bac2_ddpm4.json"),
    "planned_error": (run, "errors.json"),
    "time_queries": (run, "timings.json"),
}


def test_every_candidate_is_measured_and_the_most_promising_taken(go, policy, tmp_path):
    found, methods = go()
    (searched,) = set(found.candidates) - set(METHODS)
    assert searched.startswith("ddpm_")
    assert set(METHODS) < set(found.candidates) == set(methods)
    assert methods["bac2_ddpm4"].num_inference_steps == methods["uniform2_ddpm4"].num_inference_steps == 4
    assert methods["bac2"].num_inference_steps == 8
    families = {name: candidate.family for name, candidate in found.candidates.items()}
    assert families[searched] == families["dense"] == "stochastic"
    assert families["ddim4"] == "deterministic"
    assert families["uniform6"] == families["bac2_ddpm4"] == "cached"
    assert found.windows == 12
    assert found.chosen == found.ranking[0]
    assert found.played == {}
    assert load_acceleration(tmp_path / "acceleration.json") == found


def test_a_policy_with_cameras_is_accelerated_as_one_without(
    make_image_policy, make_image_demos, monkeypatch, tmp_path
):
    policy = make_image_policy()
    policy.sampler, demos = Sampler("ddpm", 8), make_image_demos(policy)
    asked = []
    monkeypatch.setattr(
        run,
        "time_queries",
        lambda methods, queries, **options: asked.append(queries) or TIMES(methods, queries, **options),
    )
    options = {"made_for": {"demos": "pictures.h5"}, "grid": GRID, "make_env": None}
    found, methods = run.accelerate(policy, demos, tmp_path, ask(), **options)
    assert set(METHODS) < set(found.candidates)
    assert found.candidates["dense"].error != found.candidates["ddim4"].error
    assert methods[found.chosen].vision is policy.vision
    (queries,) = asked
    assert policy(queries)["vla_action", "chunk"].shape == (3, 5, 4)


@pytest.mark.skipif(not native_available()[0], reason="only the native engine rounds")
def test_dense_and_chains_without_a_cache_are_tried_with_rounded_weights(go):
    found, _ = go(replace(GRID, rounded=("int8",)))
    (searched,) = (name for name in found.candidates if name.startswith("ddpm_") and ":" not in name)
    rounded = {name for name in found.candidates if ":" in name}
    assert rounded == {f"{name}:int8" for name in ("dense", "ddpm2_logsnr", "ddim4", searched)}
    assert found.candidates["dense:int8"].family == "rounded"
    assert found.candidates["ddpm2_logsnr:int8"].family == "stochastic"
    assert found.candidates["dense:int8"].error != found.candidates["dense"].error
    with refused("rounded"):
        Grid(rounded=("int4",))


def test_the_error_of_a_cached_chain_is_that_of_its_mask(go, policy, demos):
    found, methods = go()
    method = methods["uniform6"]
    targets, _ = run._from_demonstrations(policy, demos, Request("lift", n_action_steps=4, windows=12))
    noise = method.sample_noise(targets["diffusion", "seed"].squeeze(-1))
    mask = method.plan.mask(method.plan.spec).expand(len(targets), -1, -1)
    answers = method.denoise(noise, targets["diffusion", "cond"], mask)
    by_hand = (answers - targets["target"])[:, 1:5].abs().mean().item()
    assert found.candidates["uniform6"].error == pytest.approx(by_hand, rel=1e-5)
    assert found.candidates["uniform6"].error != found.candidates["dense"].error


@pytest.mark.parametrize("stage", STAGES)
def test_a_killed_run_goes_on_where_it_was(go, monkeypatch, tmp_path, stage):
    module, file = STAGES[stage]
    with monkeypatch.context() as killed:
        killed.setattr(module, stage, interrupted)
        with pytest.raises(KeyboardInterrupt):
            go()
    assert not (tmp_path / file).exists()
    for earlier in list(STAGES)[: list(STAGES).index(stage)]:
        monkeypatch.setattr(STAGES[earlier][0], earlier, interrupted)
    found, _ = go()
    for name, (where, _) in STAGES.items():
        monkeypatch.setattr(where, name, interrupted)
    assert go()[0] == found


def interrupted(*_, **__):
    raise KeyboardInterrupt


def test_another_budget_reuses_what_was_measured(go, monkeypatch):
    monkeypatch.setattr(run, "time_queries", fixed_times({"dense": 90, "ddim4": 4, "ddpm2_logsnr": 2}))
    assert len(go()[0].ranking) == len(METHODS)
    for name, (where, _) in STAGES.items():
        monkeypatch.setattr(where, name, interrupted)
    found, _ = go(budget_ms=5.0)
    assert set(found.ranking) == {"ddim4", "ddpm2_logsnr"}
    assert all(1e3 * found.candidates[name].latency_s.p95 <= 5 for name in found.ranking)
    with refused("budget_ms"):
        go(budget_ms=1.0)


def test_a_larger_grid_extends_what_is_there(go, monkeypatch):
    before = go()[0].candidates
    monkeypatch.setattr(candidates, "find_timesteps", interrupted)
    after = go(grid=replace(GRID, samplers=(*GRID.samplers, "ddpm5")))[0].candidates
    assert after.keys() - before.keys() == {"ddpm5"}


def test_finalists_are_played_until_they_are_decided_and_the_right_one_is_taken(go, monkeypatch, tmp_path):
    times = {"dense": 90, "ddim4": 20, "ddpm2_logsnr": 10}
    monkeypatch.setattr(run, "time_queries", fixed_times({name: times.get(name, 200) for name in METHODS}))
    monkeypatch.setattr(benchmark, "episode_horizon", lambda make_env, seeds: HORIZON)
    monkeypatch.setattr(benchmark, "evaluate", episodes_of({"dense": 20, "ddim4": 20}))
    found, _ = go(episodes=300, grid=replace(GRID, searched=()))
    assert set(found.played) == {"dense", "ddim4", "ddpm2_logsnr"}
    assert found.chosen == "ddim4"  # the other is faster, and never solves the task
    assert found.played["ddim4"].is_right
    assert found.played["ddpm2_logsnr"].paired_vs_dense.verdict == "inferior"
    assert found.played["ddpm2_logsnr"].success.n < 300
    results = load_results(tmp_path / "results.json")
    assert results.until_conclusive.max_episodes == 300
    assert results.methods["ddim4"].speedup_vs_dense == pytest.approx(4.5)
    page = read_table(tmp_path / "acceleration.json", "played")
    assert [page.name(row) for row in page.rows] == ["dense", "ddpm2_logsnr", "ddim4 (chosen)"]


def test_a_pruner_is_one_more_candidate(go):
    config = PrunerConfig(rate=0.5, max_updates=1, batch_size=2, checkpointed=False)
    found, methods = go(grid=Grid(("ddim4",), (), (), (), ()), pruner=config)
    assert found.candidates["sag"].family == "pruner"
    assert not methods["sag"].plan.is_static
    before = methods["sag"].plan.fingerprint
    assert go(grid=Grid(("ddim4",), (), (), (), ()), pruner=config)[1]["sag"].plan.fingerprint == before


def test_other_demonstrations_and_damaged_files_are_refused_by_name(go, tmp_path):
    go()
    with refused("ddpm2.json"):
        go(made_for={"demos": "other.h5"})
    (tmp_path / "errors.json").write_text('{"format": "torchrl_sparse.errors/1"}')
    with refused("errors.json: made_for"):
        go()


def test_a_file_that_disagrees_with_itself_is_refused(go, tmp_path):
    go()
    path = Path(tmp_path / "acceleration.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"chosen": "magic"}))
    with refused("acceleration.json: chosen"):
        load_acceleration(path)


def test_schedules_of_another_policy_are_refused_by_name(go, policy):
    grid = replace(GRID, searched=())
    go(grid=grid)
    with torch.no_grad():
        policy.network.pos_emb += 1
    with refused("bac2.json"):
        go(grid=grid)


def test_what_cannot_be_accelerated_is_refused_before_anything_is_written(go, policy, tmp_path):
    for field, name, message in (
        ("samplers", "magic3", "samplers: sampler"),
        ("cached", "ddpm", "cached"),
        ("searched", "ddpm_90_10", "searched"),
    ):
        with refused(message):
            replace(GRID, **{field: (name,)})
    with refused("samplers: ddpm200: num_inference_steps"):
        go(grid=replace(GRID, samplers=("ddpm200",)))
    policy.plan = Uniform(2)
    with refused("policy"):
        go()
    assert list(tmp_path.iterdir()) == []
