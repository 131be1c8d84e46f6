"""What importing costs, and what works without a simulator."""

import importlib
import pkgutil
import subprocess
import sys
from typing import Literal, get_origin

import pytest

import torchrl_sparse

HEAVY = ("robosuite", "mujoco", "wandb", "transformers", "matplotlib", "torch")
PACKAGES = ["torchrl_sparse"] + [
    module.name
    for module in pkgutil.walk_packages(torchrl_sparse.__path__, "torchrl_sparse.")
    if module.ispkg
]


def python(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.strip()


def test_importing_the_package_is_light():
    loaded = python(f"import sys, torchrl_sparse; print([m for m in {HEAVY} if m in sys.modules])")
    assert loaded == "[]"


def test_policies_training_and_blocks_need_no_simulator():
    code = """
import sys
for name in ("robosuite", "mujoco"):
    sys.modules[name] = None  # any import of it fails
from torchrl_sparse import BAC, ChunkExecutor, DiffusionPolicy, Sampler, Uniform
import torchrl_sparse.data.robomimic, torchrl_sparse.evaluation.benchmarks.summary, torchrl_sparse.training.diffusion.trainer
DiffusionPolicy.from_pretrained("assets/lift")
slow = {"diffusers", "scipy.stats", "transformers"} & {*sys.modules}  # seconds of import, which a policy does without
print(slow or "fine")
"""
    assert python(code).endswith("fine")


def test_without_transformers_everything_imports_and_a_network_says_what_it_lacks():
    code = """
import importlib, pkgutil, sys
for name in ("transformers", "tokenizers"):
    sys.modules[name] = None  # any import of it fails
import torchrl_sparse
for module in pkgutil.walk_packages(torchrl_sparse.__path__, "torchrl_sparse."):
    if not module.name.endswith(("._native", "._period")):  # compiled libraries are no modules of Python
        importlib.import_module(module.name)
try:
    torchrl_sparse.VLAPolicy.from_pretrained("assets/vla")
except ImportError as error:
    print(error)
"""
    assert "torchrl-sparse[vla]" in python(code)


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there(name):
    package = importlib.import_module(name)
    assert package.__doc__
    assert set(package.__all__) <= set(dir(package))
    for public in (getattr(package, name) for name in package.__all__):
        assert public.__doc__ or get_origin(public) is Literal, public
