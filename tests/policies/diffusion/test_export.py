"""Exported policies: a C program gives the chunks of Python, to the last bit, and nothing in a file can hurt it."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.blocks.engine.native import NativeEngine, native_available, tsp
from torchrl_sparse.blocks.planner import Planner, StaticPlanner
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer

AVAILABLE, REASON = native_available()
pytestmark = [
    pytest.mark.skipif(not AVAILABLE, reason=REASON),
    pytest.mark.skipif(not (shutil.which("cc") and shutil.which("c++")), reason="no compiler"),
]
SOURCES = Path(tsp.__file__).parent
FUZZ = Path(__file__).parents[2] / "blocks/engine/native/tsp_fuzz.c"
FLAGS = [
    "-O3",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-exceptions",
    "-fno-rtti",
]  # as CMakeLists.txt has them
# With `make sanitize`, as the Makefile has them: bits are the same only of the same optimisations.
SANITIZE = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
SANITIZE_CPP = [*SANITIZE, *FLAGS[1:]]
SANITIZED = "SANITIZED_NATIVE" in os.environ


def build(folder, program, cpp_flags, c_flags=(), prefix=""):
    """Compile the library and a C program that is linked with it, by the C compiler: nothing of C++ is needed."""
    cpp, c = (f"{prefix}g++", f"{prefix}gcc") if prefix else ("c++", "cc")
    for command in (
        [cpp, "-std=c++17", *cpp_flags, "-c", SOURCES / "tsp.cpp", "-o", folder / "tsp.o"],
        [c, *c_flags, f"-I{SOURCES}", program, folder / "tsp.o", "-lm", "-o", folder / program.stem],
    ):
        run(command, check=True)
    return folder / program.stem


def run(command, **options):
    """Without the libraries that a sanitized Python has loaded before all others."""
    environment = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    return subprocess.run([str(part) for part in command], env=environment, **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tsp")


@pytest.fixture(scope="module")
def example(folder):
    flags = (SANITIZE_CPP, SANITIZE) if SANITIZED else (FLAGS,)
    return build(folder, SOURCES / "example.c", *flags)


def make_policy(sampler=None, plan=None, **sizes):
    torch.manual_seed(0)
    sizes = {"horizon": 6, "n_obs_steps": 2, "cond_dim": 5, "n_layer": 2, "n_emb": 32} | sizes
    network = TransformerForDiffusion(input_dim=7, output_dim=7, **sizes)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    state, action = torch.randn(50, sizes["cond_dim"]), 3 * torch.randn(50, 7)
    normalizer = Normalizer.fit(state, action, state_mode="range", poses=False)
    policy = DiffusionPolicy(network, normalizer, sampler=sampler or Sampler("ddpm", 8), plan=plan)
    policy.noise = "philox"
    return policy


def run_example(example, path, history, seeds, runner=()):
    lines = [
        f"{seed} " + " ".join(value.hex() for value in row.double().flatten().tolist())
        for seed, row in zip(seeds, history, strict=True)
    ]
    done = run([*runner, example, path], input="\n".join(lines), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return torch.tensor([[float.fromhex(word) for word in line.split()] for line in done.stdout.splitlines()])


def answers(example, policy, path, runner=(), **options):
    """Export, and return the file's chunks of some policy calls and the policy's own."""
    policy.export(path, **options)
    network, seeds = policy.network, [0, 1, 2**40 + 3, 2**63 - 1]
    history = torch.randn(
        4, network.n_obs_steps, network.cond_dim, generator=torch.Generator().manual_seed(1)
    )
    with torch.no_grad():
        data = TensorDict({"history": {"state": history}}, [4])
        policy.module["encode"](data)
        data["diffusion", "seed"] = torch.tensor(seeds)[:, None]
        for stage in ("plan", "denoise"):
            policy.module[stage](data)
    expected = data["vla_action", "chunk"].flatten(1)
    assert expected.isfinite().all()
    return run_example(example, path, history, seeds, runner), expected


def check_equal(example, policy, path, **options):
    """Export, and compare the answers to some policy calls bit by bit."""
    got, expected = answers(example, policy, path, **options)
    assert torch.equal(got, expected)
    assert not torch.equal(got[0], got[1])


@pytest.mark.skipif(SANITIZED, reason="compiles for other machines")
@pytest.mark.parametrize(
    ("prefix", "runner", "flags"),
    [
        ("", [], ["-DPORTABLE_ONLY"]),
        ("aarch64-linux-gnu-", ["qemu-aarch64"], []),
    ],
    ids=["portable", "ARM"],
)
def test_other_machines_answer_alike(example, tmp_path, prefix, runner, flags):
    """As far as the order of sums allows, whatever the type of the weights."""
    if prefix and not (shutil.which(f"{prefix}g++") and shutil.which(runner[0])):
        pytest.skip(f"no {prefix}g++ (Debian's g++-aarch64-linux-gnu) or no {runner[0]} (qemu-user)")
    other = build(tmp_path, SOURCES / "example.c", ["-O1", *FLAGS[1:], *flags], ["-static"], prefix)
    # Sixteen actions and more than one part of inputs fill every kind of tile.
    policy = make_policy(Sampler("unipc", 4), plan=Half("block"), horizon=16, n_emb=96)
    for weights, most in (("float32", 1e-4), ("float16", 1e-4), ("bfloat16", 0.1)):
        path = tmp_path / f"{weights}.tsp"
        here, _ = answers(example, policy, path, weights=weights)
        there, _ = answers(other, policy, path, runner, weights=weights)
        assert (there - here).abs().max() < most, weights


class Half(StaticPlanner):
    def __init__(self, reuse):
        super().__init__()
        self.reuse = reuse

    def mask(self, spec):
        mask = (
            torch.rand(spec.num_inference_steps, spec.num_blocks, generator=torch.Generator().manual_seed(0))
            < 0.5
        )
        mask[0] = False
        return mask


def make_pruner(policy, **options):
    shape = (policy.n_obs_steps, policy.network.cond_dim)
    torch.manual_seed(1)
    network = PrunerNetwork(policy.sampler.timesteps.tolist(), policy.num_blocks, shape, **options)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    rates = (0.2, 0.8) if network.rate_input else None
    return SAGPruner(network, PrunerInfo(policy.fingerprint, policy.sampler.name, 0.5, rates))


@pytest.mark.parametrize("name", ["ddpm8", "ddim_87_20", "ddim_90_50_10_eta0.5", "unipc5", "sde2m4"])
def test_every_kind_of_sampler(example, tmp_path, name):
    check_equal(example, make_policy(Sampler.from_name(name)), tmp_path / "policy.tsp")


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_masks_under_every_rule(example, tmp_path, reuse):
    check_equal(example, make_policy(plan=Half(reuse)), tmp_path / "policy.tsp")


@pytest.mark.parametrize("options", [{}, {"rate_input": True, "hidden": 20}], ids=["decides", "at a rate"])
def test_pruners(example, tmp_path, options):
    policy = make_policy()
    policy.plan = make_pruner(policy, **options)
    check_equal(example, policy, tmp_path / "policy.tsp")


@pytest.mark.parametrize("weights", ["float16", "bfloat16"])
@pytest.mark.parametrize(
    "sizes", [{"n_emb": 42, "n_head": 3, "cond_dim": 3}, {"horizon": 3, "n_obs_steps": 3, "n_emb": 96}]
)
def test_half_precision_and_other_sizes(example, tmp_path, weights, sizes):
    policy = make_policy(**sizes)
    engine = NativeEngine(policy.network, policy.sampler, weights=weights)
    policy.module["denoise"].engine.get = lambda *_, **__: engine
    check_equal(example, policy, tmp_path / "policy.tsp", weights=weights)


def test_a_trained_policy_in_two_steps(example, tmp_path):
    policy = DiffusionPolicy.from_pretrained("assets/lift")
    policy.sampler, policy.noise = Sampler("ddim", timesteps=[87, 20]), "philox"
    check_equal(example, policy, tmp_path / "lift.tsp")


def test_what_is_wrong_with_a_file_is_one_line_of_the_example(example, tmp_path):
    path = tmp_path / "absent.tsp"
    done = run([example, path], capture_output=True, text=True)
    expected = f"{path}: expected a file that can be read (No such file or directory)\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", expected)


def test_no_damaged_file_does_harm(example, folder, tmp_path):
    """A file that was damaged on purpose, its checksum made good, may be run and must be safe."""
    policy = make_policy(
        Sampler("ddpm", 2), n_emb=8, n_layer=1, n_head=2, horizon=2, cond_dim=1, n_obs_steps=1
    )
    policy.plan = make_pruner(policy, rate_input=True, hidden=4, width=4, obs_width=2)
    path = tmp_path / "policy.tsp"
    policy.export(path)
    if SANITIZED:
        program = build(tmp_path, FUZZ, SANITIZE_CPP, SANITIZE)
    else:
        program = tmp_path / "fuzz"
        run(["cc", f"-I{SOURCES}", FUZZ, folder / "tsp.o", "-lm", "-o", program], check=True)
    done = run([program, path, 61 if SANITIZED else 509], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.fullmatch(r"0 taken, [1-9]\d* harmless\n", done.stdout)


class Looks(Planner):
    def masks(self, cond):
        return torch.zeros(len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool)


def with_camera():
    vision = VisionEncoder(["image"], image_size=(64, 64), crop_size=(64, 64), width=16)
    plain = make_policy(cond_dim=5)
    network = make_policy(cond_dim=5 + vision.feature_dim).network
    return DiffusionPolicy(network, plain.normalizer, vision=vision)


def test_what_cannot_be_exported_is_refused_and_nothing_is_written(tmp_path):
    path = tmp_path / "policy.tsp"
    with refused("plan"):
        make_policy(plan=Looks()).export(path)
    with refused("export"):
        with_camera().export(path)
    with refused("weights"):
        make_policy().export(path, weights="int8")
    with refused("export"):
        make_policy(n_cond_layers=1).export(path)
    with refused("noise"):
        make_policy().noise = "mt19937"
    assert list(tmp_path.iterdir()) == []
