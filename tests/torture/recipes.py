"""The recipes that run long, at settings that take seconds, and what they read."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from tests.evaluation.synthetic import make_results
from tests.fixtures.demonstrations import describe, hands
from tests.torture.formats import small_policy
from tests.torture.processes import recipe
from tests.training.vla.rendered import write_demos as write_rendered
from torchrl_sparse.evaluation.results.schema import save_results

ENVIRONMENT = {"OMP_NUM_THREADS": "1", "WANDB_MODE": "offline", "WANDB_SILENT": "true", "MPLBACKEND": "agg"}
_STATE = {"object": 10, "robot0_gripper_qpos": 2}

TRIAL = """
import os, shutil, sys, time
from pathlib import Path

out = Path(os.environ["SWEEP_OUT"]) / os.environ["WANDB_RUN_ID"]
out.mkdir(exist_ok=True)
time.sleep(1.0)
shutil.copy(Path(__file__).with_name("template.json"), out / "results.json.part")
os.replace(out / "results.json.part", out / "results.json")
"""


@dataclass(frozen=True)
class TinyRecipe:
    """A recipe at a setting that takes seconds.

    Attributes:
        name: of the recipe, and what is special about the setting.
        recipe: its file.
        options: all but where its results go.
        out: the file or, ending in a slash, the folder that its results go to, within a folder.
        workers: whether it starts processes that do its work.
    """

    name: str
    recipe: str
    options: tuple[str, ...]
    out: str = "out/"
    workers: bool = False
    environment: dict[str, str] = field(default_factory=lambda: ENVIRONMENT)

    def command(self, folder: Path) -> list[str]:
        """Return the command whose results lie in ``folder``."""
        return recipe(self.recipe, *self.options, f"out={folder / self.out}")


def tiny_recipes(work: Path) -> Iterator[TinyRecipe]:
    """Write what the recipes read into the folder ``work`` and yield them; those of extras only where these are installed."""
    demos, policy = _write_demos(work / "demos.h5"), work / "policy"
    small_policy().save_pretrained(policy)
    network = ("network.n_layer=1", "network.n_emb=16", "network.n_head=2")
    often = ("batch_size=4", "log_every=5", "checkpoint_every=20", "lr_warmup_steps=2", "threads=1")
    yield TinyRecipe("train_policy", "train_policy", (f"demos={demos}", *network, *often, "max_steps=120"))
    pruner = (
        f"policy={policy}", f"demos={demos}", "sampler={kind: ddim, num_inference_steps: 5}", "targets.share=0.4",
        "rate=0.5", "train.max_updates=60", "train.batch_size=4", "log_every=5", "checkpoint_every=10", "threads=1",
    )  # fmt: skip
    yield TinyRecipe("train_pruner", "train_pruner", pruner)
    if importlib.util.find_spec("transformers"):
        sizes = ("size=tiny", "network.chunk_size=3", "+network.llm.layers=2", "batch_size=2", "max_steps=60")
        stages = ("grounding.locate_steps=10", "grounding.refer_steps=10", "checkpoint_every=10", *often[3:])
        rendered = write_rendered(work / "images.h5")
        yield TinyRecipe("train_vla", "train_vla", (f"demos={rendered}", *sizes, *stages, "log_every=5"))
    yield TinyRecipe("collect_demos", "collect_demos", ("task=lift", "episodes=4"), out="out/demos.h5")
    few = ("episodes=3", "horizon=16", "latency_repeats=1", "probe_episodes=1", "videos=[]")
    benchmark = ("task=lift", f"policy={policy}", *few)
    yield TinyRecipe("benchmark", "benchmark", (*benchmark, "methods=[dense,ddim2]"))
    realtime = ("task=lift_moving", f"policy={policy}", "methods=[ddim2]", "latencies=[0.1]", *few[:3])
    yield TinyRecipe("realtime", "realtime", realtime)
    if importlib.util.find_spec("sweeps"):
        yield TinyRecipe("sweep", "sweep", (f"sweep={_write_sweep(work / 'sweep')}",))
    yield TinyRecipe(
        "benchmark, workers=2", "benchmark", (*benchmark, "methods=[dense]", "workers=2"), workers=True
    )
    yield TinyRecipe(
        "collect_demos, workers=2",
        "collect_demos",
        ("task=lift", "episodes=4", "workers=2"),
        "out/demos.h5",
        True,
    )


def _write_demos(path: Path) -> Path:
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(4):
            demo = file.create_group(f"data/demo_{index}")
            demo.attrs["num_samples"] = 15
            demo["actions"] = actions = random.uniform(-1, 1, (15, 7))
            demo["obs/robot0_eef_pos"], demo["obs/robot0_eef_quat_site"] = hands(actions)
            for key, size in _STATE.items():
                demo[f"obs/{key}"] = random.uniform(-1, 1, (15, size))
        describe(file)
    return path


def _write_sweep(folder: Path) -> Path:
    """Write a sweep of five trials of a second each; what a benchmark survives is measured on the benchmark itself."""
    folder.mkdir()
    (folder / "trial.py").write_text(TRIAL)
    save_results(make_results(20, names=("dense", "bac")), folder / "template.json")
    sweep = {
        "program": str(folder / "trial.py"),
        "method": "grid",
        "metric": {"name": "tested/success", "goal": "maximize"},
        "parameters": {"num_updates": {"values": [1, 2, 3, 4, 5]}},
        "command": ["${env}", "python", "${program}", "${args_no_hyphens}"],
    }
    path = folder / "sweep.yaml"
    path.write_text(json.dumps(sweep))
    return path
