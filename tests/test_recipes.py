"""Every recipe, at toy size, in the order in which a user runs them."""

# ruff: noqa: F811, what is imported are fixtures

import json
import shutil
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch
from safetensors.torch import load_file

from tests.fixtures.recipes import demos, policy, schedules, work  # noqa: F401
from tests.recipe_modules import run
from torchrl_sparse import DiffusionPolicy, SAGPruner
from torchrl_sparse.blocks.mask import prune_rate
from torchrl_sparse.blocks.schedule import CacheSchedule
from torchrl_sparse.data.robomimic import read_demos
from torchrl_sparse.envs.tasks import find_robosuite_task
from torchrl_sparse.evaluation import load_results
from torchrl_sparse.evaluation.results.realtime import load_realtime

METHODS = ("dense", "dense_noise", "ddim10", "uniform", "bac_unified", "bac_blockwise", "bac")


def test_a_policy_is_evaluated(work, policy):
    options = (
        "episodes=2",
        "horizon=9",
        "sampler={kind: ddpm, num_inference_steps: 4}",
        f"out={work}/played",
    )
    line = f"{policy}: success 0/2 [0.00, 0.66], score 0.000 (standard error 0.000), steps 9.0"
    assert line in run("evaluate_policy", f"policy={policy}", *options)
    log = work / "played" / "episodes" / "dense.jsonl"
    played = log.read_bytes()
    assert line in run("evaluate_policy", f"policy={policy}", *options)
    assert log.read_bytes() == played
    refused = run("evaluate_policy", f"policy={policy}", "demos=demos.h5", *options, expect=2)
    assert "task: expected one that tells its ways, got 'Lift', which does not" in refused


def test_few_steps_are_found_and_benchmarked_by_name(work, demos, policy, schedules):
    options = (f"policy={policy}", f"demos={demos}")
    search = ("num_inference_steps=2", "strides=[20]", "targets.share=0.1")
    output = run("calibrate_timesteps", *options, *search, "kind=ddpm", f"out={work}/timesteps")
    (path,) = (work / "timesteps").iterdir()
    found = json.loads(path.read_text())
    assert path.stem == "ddpm_" + "_".join(map(str, found["tried"][0]["timesteps"]))
    assert f"{path.stem}, error" in output
    assert "logsnr: [91, 41], error" in output
    assert [found["spacings"][name]["timesteps"] for name in ("leading", "logsnr")] == [[50, 0], [91, 41]]
    # Chains that end at timestep 0: this policy has learned too little to end anywhere else.
    methods = ["dense", "ddpm4", "ddim4_eta0.5", "uniform2_ddpm4", "bac_ddpm4"]
    run(
        "benchmark", f"policy={policy}", f"methods=[{','.join(methods)}]", "episodes=1", "horizon=16", "latency_repeats=2",
        "probe_episodes=1", f"planners={schedules}", f"out={work}/few",
    )  # fmt: skip
    made = load_results(work / "few" / "results.json").methods
    assert list(made) == methods
    assert made["ddpm4"].flops.ratio_to_dense == made["ddim4_eta0.5"].flops.ratio_to_dense == 0.04
    assert 0.02 < made["bac_ddpm4"].flops.ratio_to_dense < 0.04
    assert made["uniform2_ddpm4"].flops.ratio_to_dense == pytest.approx(0.03, abs=0.002)


def test_a_policy_drives_and_is_trained_on_with_what_it_was_taught(work, demos, policy):
    driven = (f"policy={policy}", "method=ddim2", "mixing=1", f"out={work}/driven.h5")
    assert "kept 2" in run("collect_demos", "task=lift", "episodes=2", "seed=9", *driven)
    options = (f"init={policy}", f"out={work}/driven", "max_steps=2", "batch_size=8", "train.val_ratio=0")
    output = run("train_policy", f"demos=[{demos},{work}/driven.h5]", *options)
    assert "4 demonstrations" in output
    refused = run("collect_demos", f"policy={policy}", "mixing=2", f"out={work}/no.h5", expect=2)
    assert "mixing: expected less than or equal to 1, got 2" in refused


def test_training_exports_a_policy(policy):
    assert DiffusionPolicy.from_pretrained(policy).num_inference_steps == 100


def test_calibration_writes_a_schedule_per_method(schedules):
    assert sorted(file.name for file in schedules.iterdir()) == [
        "bac.json",
        "bac_blockwise.json",
        "bac_ddpm4.json",
        "bac_unified.json",
    ]


def test_conversion_makes_what_training_reads(work, demos):
    out = work / "converted.h5"
    assert f"{out}: 2 demonstrations" in run("convert_demos", f"demos={demos}", f"out={out}")
    assert len(read_demos(out, find_robosuite_task("lift").state_keys)) == 2


def test_image_policies_go_the_same_way(work, demos):
    """Rendered, trained, and calibrated in an environment with the same cameras."""
    views = "cameras=[agentview,robot0_eye_in_hand]"
    options = (f"demos={demos}", f"out={work}/images.h5", views, "image_size=40")
    output = run("convert_demos", *options, expect=None)
    if "rendering needs a GL library" in output:
        pytest.skip("no GL library")
    cameras = ("cameras.image=agentview_image", "cameras.wrist_image=robot0_eye_in_hand_image")
    small = ("vision.width=16", "network.n_layer=2", "network.n_emb=16", "train.val_ratio=0", *cameras)
    run(
        "train_policy", f"demos={work}/images.h5", f"out={work}/seeing", "max_steps=2", "batch_size=4", *small
    )
    policy = DiffusionPolicy.from_pretrained(work / "seeing" / "policy")
    assert policy.vision.config["crop_size"] == [36, 36]
    assert policy.network.cond_dim == 2 * 64 + 9
    assert policy.source["cameras"]["wrist_image"] == "robot0_eye_in_hand_image"
    calibrate = ("num_updates=7", f"policy={work}/seeing/policy", f"out={work}/seeing/schedules")
    assert "bac.json: prune rate 0." in run("calibrate_bac", *calibrate)


def test_benchmark_leaves_a_table_pictures_and_videos(work, policy, schedules):
    out = work / "benchmark"
    options = (
        "task=lift", f"policy={policy}", f"planners={schedules}", "num_updates=7",
        "num_envs=2", "horizon=16", "latency_repeats=2", "probe_episodes=1", f"out={out}",
    )  # fmt: skip
    named = f"methods=[{','.join(METHODS)}]"
    output = run("benchmark", *options, named, "episodes=2", "logger=wandb")
    results = load_results(out / "results.json")
    assert tuple(results.methods) == METHODS
    assert results.dense.success.n == 2
    assert results.dense.action_error_vs_dense.max < 1e-5
    assert results.methods["uniform"].flops.ratio_to_dense < 0.5
    assert all(name in output for name in METHODS)
    pictures = ["pareto", "similarity", "error_surge", *(f"schedule_{name}" for name in METHODS)]
    for name in pictures:
        assert iio.imread(out / f"{name}.png").std() > 5
    videos = sorted(file.name for file in out.glob("*.mp4"))
    assert (
        videos == ["rollout_bac.mp4", "rollout_dense.mp4"]
        or "no video: rendering needs a GL library" in output
    )

    media = next(out.glob("wandb/offline-run-*/files/media"))
    logged = {path.suffix for path in media.rglob("*.*")}
    assert logged == {".png", ".json", *(Path(video).suffix for video in videos)}

    logs = {file.name: file.read_bytes() for file in (out / "episodes").iterdir()}
    run("benchmark", *options, "methods=[dense,bac]", "episodes=3", "videos=[]")
    assert load_results(out / "results.json").dense.success.n == 3
    for name, log in logs.items():  # a longer run reads the episodes of a shorter one instead of running them
        again = (out / "episodes" / name).read_bytes()
        assert again.startswith(log)
        assert (again != log) == (name in ("dense.jsonl", "bac.jsonl"))
    found = f"methods: {', '.join([*METHODS, 'bac_ddpm4'])}"  # which is a schedule beside the others
    assert found in run("benchmark", *options, "methods=null", "videos=[magic]", expect=2)


def test_realtime_leaves_a_curve_per_method(work, demos, policy):
    out = work / "realtime"
    few = ("latencies=[0,0.1]", "episodes=1", "horizon=12", "latency_repeats=1")
    options = (f"policy={policy}", "methods=[ddim2_every2_of3_ahead]", *few, f"out={out}")
    assert "demos: expected demonstrations to fit" in run("realtime", *options, expect=2)
    output = run("realtime", *options, f"demos={demos}")
    assert "3 steps ahead the model of the state errs by " in output
    results = load_realtime(out / "realtime.json")
    assert list(results.methods) == ["dense", "ddim2_every2_of3_ahead"]
    for name, method in results.methods.items():
        assert name in output
        assert {0, 2} <= {point.delay_steps for point in method.points}
        assert sum(point.own for point in method.points) == 1
    assert iio.imread(out / "realtime.png").std() > 5


def test_pruners_are_trained_and_benchmarked_by_name(work, demos, policy, schedules):
    training = (
        f"policy={policy}", f"demos={demos}", "sampler={kind: ddim, num_inference_steps: 5}", "targets.share=0.3",
        "rate=0.5", "train.max_updates=2", "train.batch_size=4", "log_every=1", "checkpoint_every=1",
    )  # fmt: skip
    output = run("train_pruner", *training, f"out={work}/sag", "train.rate_range=[0.3,0.7]")
    assert "step 2 of 2, finished" in output
    assert f"planners={work}/sag methods=[dense,pruner,fixed]" in output
    assert "resumed from step 2" in run(
        "train_pruner", *training, f"out={work}/sag", "train.rate_range=[0.3,0.7]"
    )
    assert iio.imread(work / "sag" / "curves.png").std() > 5
    output = run(
        "train_pruner",
        "method=l2c",
        "reuse=block",
        *training,
        f"out={work}/l2c",
        f"init={work}/sag/fixed.json",
        "rollouts=1",
    )
    assert "fixed.json: fitted" in output
    windows, joined = (load_file(work / out / "targets.safetensors")["target"] for out in ("sag", "l2c"))
    assert len(joined) > len(windows)
    taught = [
        CacheSchedule.from_pretrained(work / name).mask() for name in ("sag/fixed.json", "l2c/l2c.json")
    ]
    output = run(
        "train_pruner", *training, f"out={work}/taught", "train.rate_range=[0.1,0.7]", "train.max_updates=0",
        f"init=[{work}/sag/fixed.json,{work}/l2c/l2c.json]",
    )  # fmt: skip
    assert "step 0 of 0, finished" in output
    pruner = SAGPruner.from_pretrained(work / "taught" / "pruner")
    cond = torch.zeros(1, *pruner.network.cond_shape)
    for mask in taught:
        learned = pruner.masks(cond, prune_rate(mask).view(1, 1))[0]
        assert (learned == mask).float().mean() > 0.9
    own = ("method=l2c", "reuse=block", "objective=noise", f"out={work}/own")
    assert "step 2 of 2, finished" in run("train_pruner", *training, *own, "rate=0.3")
    assert CacheSchedule.from_pretrained(work / "own" / "l2c_noise.json").method == "l2c_noise"
    plans = shutil.copytree(schedules, work / "plans")
    shutil.copytree(work / "sag" / "pruner", plans / "sag")
    for path in (work / "l2c" / "l2c.json", work / "sag" / "fixed.json"):
        shutil.copy(path, plans)

    methods = ("dense", "l2c", "fixed", "sag@0.5", "sag@0.6-0.4")
    output = run(
        "benchmark", f"policy={policy}", f"planners={plans}", "num_updates=7", f"methods=[{','.join(methods)}]",
        "episodes=1", "horizon=16", "latency_repeats=2", "probe_episodes=1", "videos=[sag@0.5]", f"out={work}/sparse",
    )  # fmt: skip
    entries = load_results(work / "sparse" / "results.json").methods
    assert tuple(entries) == methods
    assert [name for name in methods if entries[name].planning_s] == list(methods[3:])
    for name in methods[3:]:
        assert iio.imread(work / "sparse" / f"strip_{name}.png").std() > 5
        assert iio.imread(work / "sparse" / f"masks_{name}.png").std() > 5
    assert (work / "sparse" / "rollout_sag@0.5.mp4").exists() or "rendering needs a GL library" in output


def test_unknown_names_are_refused_before_any_work(work, policy):
    output = run("benchmark", f"policy={policy}", "methods=[dense,magic]", f"out={work}/none", expect=2)
    assert "methods: expected dense, dense_noise, ddim10, uniform, bac, " in output
    assert "got 'magic'" in output
    assert not (work / "none").exists()
    assert "task: expected one of Lift" in run("benchmark", "task=juggle", f"policy={policy}", expect=2)


def test_a_schedule_of_another_policy_is_refused(work, policy, schedules):
    foreign = json.loads((schedules / "bac.json").read_text())
    foreign["policy"] = "0123456789abcdef"
    (work / "foreign").mkdir()
    (work / "foreign" / "bac.json").write_text(json.dumps(foreign))
    options = (
        f"policy={policy}",
        f"planners={work}/foreign",
        "num_updates=7",
        "methods=[bac]",
        f"out={work}/none",
    )
    assert "made for policy fingerprint '0123456789abcdef'" in run("benchmark", *options, expect=2)
