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
import torchrl_sparse.data.robomimic, torchrl_sparse.training.diffusion.trainer
print("fine")
"""
    assert python(code).endswith("fine")


def test_without_transformers_all_but_the_network_imports():
    """The modules that need the network say so; of the others only those of the policy and its benchmark are among them."""
    code = """
import importlib, pkgutil, sys
sys.modules["transformers"] = None  # any import of it fails
import torchrl_sparse
for module in pkgutil.walk_packages(torchrl_sparse.__path__, "torchrl_sparse."):
    try:
        importlib.import_module(module.name)
    except ImportError as error:
        if "torchrl-sparse[vla]" in str(error):
            print(module.name)
"""
    need = set(python(code).split())
    assert "torchrl_sparse.policies.vla.policy" in need
    assert all("vla" in name for name in need)
    network = {"backbones", "decoder", "network", "vision"}
    assert {name.split(".")[-1] for name in need if ".networks." in name} == network
    assert not [name for name in need if ".tokens" in name or ".methods" in name or ".envs" in name]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there(name):
    package = importlib.import_module(name)
    assert package.__doc__
    assert set(package.__all__) <= set(dir(package))
    for public in (getattr(package, name) for name in package.__all__):
        assert public.__doc__ or get_origin(public) is Literal, public
