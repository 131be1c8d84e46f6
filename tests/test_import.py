"""What importing costs, and what works without a simulator."""

import subprocess
import sys

import torchrl_sparse

HEAVY = ("robosuite", "mujoco", "wandb", "transformers", "matplotlib", "torch")


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
    code = """
import sys
sys.modules["transformers"] = None  # any import of it fails
from torchrl_sparse import BAC, ChunkExecutor, DiffusionPolicy, TokenPruner, VLAConfig
import torchrl_sparse.networks.vla.flops, torchrl_sparse.networks.vla.text, torchrl_sparse.networks.vla.normalize
try:
    from torchrl_sparse import VLAPolicy
except ImportError as error:
    print(error)
"""
    assert "torchrl-sparse[vla]" in python(code)


def test_every_public_name_is_there():
    for name in torchrl_sparse.__all__:
        assert getattr(torchrl_sparse, name).__doc__, name
    assert set(torchrl_sparse.__all__) <= set(dir(torchrl_sparse))
