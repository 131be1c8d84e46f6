"""Every recipe, at toy size, in the order in which a user runs them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import pytest

from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.evaluation import load_results

RECIPES = Path(__file__).parents[1] / "recipes"
METHODS = ("dense", "ddim10", "uniform", "bac_unified", "bac_blockwise", "bac")


def run(recipe, *options, expect=0):
    command = [sys.executable, str(RECIPES / f"{recipe}.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert expect is None or done.returncode == expect, done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("recipes")


@pytest.fixture(scope="module")
def demos(work):
    output = run("collect_demos", "task=lift", "episodes=2", f"out={work}/demos.h5")
    assert "successes/attempts 2/2" in output
    return work / "demos.h5"


@pytest.fixture(scope="module")
def policy(work, demos):
    small = ("network.n_layer=2", "network.n_emb=16", "network.n_head=2", "train.val_ratio=0")
    run("train_policy", f"demos={demos}", f"out={work}/run", "max_steps=4", "batch_size=8", *small)
    return work / "run" / "policy"


@pytest.fixture(scope="module")
def schedules(work, policy):
    output = run("calibrate_bac", f"policy={policy}", f"out={work}/schedules", "num_updates=7")
    assert "bac.json: prune rate 0." in output
    return work / "schedules"


def test_training_exports_a_policy(policy):
    assert DiffusionPolicy.from_pretrained(policy).num_inference_steps == 100


def test_calibration_writes_a_schedule_per_method(schedules):
    assert sorted(file.name for file in schedules.iterdir()) == [
        "bac.json",
        "bac_blockwise.json",
        "bac_unified.json",
    ]


def test_image_policies_go_the_same_way(work, demos):
    """Rendered, trained, and calibrated in an environment with the same cameras."""
    options = (f"demos={demos}", f"out={work}/images.h5", "image_size=40")
    output = run("render_demos", *options, expect=None)
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
        "task=lift", f"policy={policy}", f"schedules={schedules}", "num_updates=7", f"methods=[{','.join(METHODS)}]",
        "episodes=2", "num_envs=2", "horizon=16", "latency_repeats=2", "probe_episodes=1", f"out={out}",
    )  # fmt: skip
    output = run("benchmark", *options)
    results = load_results(out / "results.json")
    assert tuple(results["methods"]) == METHODS
    assert results["methods"]["dense"]["success"]["n"] == 2
    assert results["methods"]["dense"]["action_error_vs_dense"]["max"] < 1e-5
    assert results["methods"]["uniform"]["flops"]["ratio_to_dense"] < 0.5
    assert all(name in output for name in METHODS)
    pictures = ["pareto", "similarity", "error_surge", *(f"schedule_{name}" for name in METHODS)]
    for name in pictures:
        assert iio.imread(out / f"{name}.png").std() > 5
    videos = sorted(file.name for file in out.glob("*.mp4"))
    assert (
        videos == ["rollout_bac.mp4", "rollout_dense.mp4"]
        or "no video: rendering needs a GL library" in output
    )

    logs = {file.name: file.read_bytes() for file in (out / "episodes").iterdir()}
    run("benchmark", *options)  # a second run reads the episodes instead of running them
    assert {file.name: file.read_bytes() for file in (out / "episodes").iterdir()} == logs


def test_unknown_names_are_refused_before_any_work(work, policy):
    output = run("benchmark", f"policy={policy}", "methods=[dense,magic]", f"out={work}/none", expect=1)
    assert "methods: expected dense, ddim<N>, uniform" in output
    assert "got 'magic'" in output
    assert not (work / "none").exists()
    assert "task: expected one of Lift" in run("benchmark", "task=juggle", f"policy={policy}", expect=1)


def test_a_schedule_of_another_policy_is_refused(work, policy, schedules):
    foreign = json.loads((schedules / "bac.json").read_text())
    foreign["policy"] = "0123456789abcdef"
    (work / "foreign").mkdir()
    (work / "foreign" / "bac.json").write_text(json.dumps(foreign))
    options = (
        f"policy={policy}",
        f"schedules={work}/foreign",
        "num_updates=7",
        "methods=[bac]",
        f"out={work}/none",
    )
    assert "made for policy fingerprint '0123456789abcdef'" in run("benchmark", *options, expect=1)
