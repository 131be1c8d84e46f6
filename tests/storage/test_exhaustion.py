"""Small files of our own formats that ask for much: each is read or refused within the limits of `tests.limits`."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.limits import SMALL_FILE, check_limits
from torchrl_sparse import CacheSchedule, DiffusionPolicy, SAGPruner
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy

SIZES = {
    "input_dim": 4,
    "output_dim": 4,
    "horizon": 4,
    "n_obs_steps": 2,
    "cond_dim": 5,
    "n_layer": 1,
    "n_emb": 8,
}
HUGE = 10**4000


def read_schedule(path):
    CacheSchedule.from_pretrained(path).mask()


@pytest.fixture
def diffusion(tmp_path):
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(4), torch.zeros(4))
    DiffusionPolicy(TransformerForDiffusion(**SIZES), normalizer).save_pretrained(tmp_path)
    return tmp_path


@pytest.fixture
def vla(tmp_path):
    VLAPolicy(VLANetwork(VLAConfig.tiny())).save_pretrained(tmp_path)
    return tmp_path


@pytest.fixture
def pruner(tmp_path):
    network = PrunerNetwork([75, 50, 25, 0], 3, (2, 5), width=8, obs_width=8, hidden=8)
    SAGPruner(network, PrunerInfo(policy="8d1f", sampler="ddim", rate=0.7)).save_pretrained(tmp_path)
    return tmp_path


def add_cameras(folder):
    """Make the files of a policy with a camera and no state; only one of its weights is in its file."""
    tensors = load_file(folder / "model.safetensors")
    tensors |= {f"normalizer.state_{part}": torch.zeros(0) for part in ("scale", "offset")}
    tensors["network.cond_obs_emb.weight"] = torch.zeros(8, 64)
    save_file(tensors, folder / "model.safetensors")
    save_file({"encoders.image.linear.bias": torch.zeros(64)}, folder / "vision.safetensors")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({"vision": {}, **config}))
    edit(folder, "network", cond_dim=64)


def edit(folder, part, **changes):
    file = folder / "config.json"
    config = json.loads(file.read_text())
    config[part] = {**config[part], **changes}
    file.write_text(json.dumps(config))


def test_honest_files_are_read(diffusion):
    assert check_limits(DiffusionPolicy.from_pretrained, diffusion) is None


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        ("schedule", {"num_train_timesteps": 10**12}, "num_train_timesteps: expected a whole number from 1 to 10000"),
        ("schedule", {"num_train_timesteps": HUGE}, "num_train_timesteps: expected a whole number from 1 to 10000"),
        ("schedule", {"kind": "ddim", "timesteps": [9] * 10**6}, "timesteps: expected 100"),
        ("network", {"n_emb": 40_000, "n_head": 4}, r"expected shape"),
        ("network", {"n_emb": 10**12, "n_head": 1}, "n_emb: expected a whole number from 1 to 65536"),
        ("network", {"n_emb": HUGE}, "n_emb: expected a whole number from 1 to 65536"),
        ("network", {"n_emb": 8.0}, "n_emb: expected a whole number from 1 to 65536, got 8.0"),
        ("network", {"cond_dim": 60_000}, "expected shape"),
        ("network", {"n_layer": 256}, "missing"),
        ("network", {"n_layer": 10**9}, "n_layer: expected a whole number from 1 to 256"),
        ("network", {"n_cond_layers": 10**9}, "n_cond_layers: expected a whole number from 0 to 256"),
        ("network", {"horizon": 60_000}, "horizon: expected a whole number from 1 to 4096"),
        ("network", {"n_obs_steps": True}, "n_obs_steps: expected a whole number from 1 to 4096, got True"),
        ("vision", {"cameras": [f"camera{i}" for i in range(10**5)]}, "cameras: expected different names, 1 to 16"),
        ("vision", {"cameras": ["a.b"]}, "cameras: expected different names, 1 to 16"),
        ("vision", {"cameras": ["image"], "width": 16 * 10**9}, "width: expected a whole number from 1 to 4096"),
        ("vision", {"cameras": ["image"], "width": 4096}, "vision.safetensors: tensors: missing"),
        ("vision", {"cameras": ["image"], "image_size": [10**9] * 2}, "expected a whole number from 1 to 4096"),
    ],
)  # fmt: skip
def test_sizes_of_a_policy(diffusion, part, changes, message):
    if part == "vision":
        add_cameras(diffusion)
    edit(diffusion, part, **changes)
    assert message in check_limits(DiffusionPolicy.from_pretrained, diffusion)


def test_the_longest_horizon_that_weights_can_bear_out(diffusion):
    tensors = load_file(diffusion / "model.safetensors")
    tensors["network.pos_emb"] = torch.zeros(1, 4096, 8)
    save_file(tensors, diffusion / "model.safetensors")
    edit(diffusion, "network", horizon=4096)
    assert check_limits(DiffusionPolicy.from_pretrained, diffusion) is None


def test_a_header_of_thousands_of_tensors(diffusion):
    file = diffusion / "model.safetensors"
    save_file(load_file(file) | {f"network.layer.{i}.weight": torch.zeros(1) for i in range(80_000)}, file)
    assert "unexpected ['network.layer" in check_limits(DiffusionPolicy.from_pretrained, diffusion)


@pytest.mark.parametrize("kind", ["lists", "dicts", "numbers", "deep"])
def test_json_of_millions_of_parts(diffusion, kind):
    part = {"lists": "[0],", "dicts": '{"a":0},', "numbers": "1,", "deep": "["}[kind]
    text = '{"format": [' + part * ((SMALL_FILE - 20_000) // len(part))
    (diffusion / "config.json").write_text(text + "0]}")
    assert "config.json: " in check_limits(DiffusionPolicy.from_pretrained, diffusion)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"llm": {"layers": 10**9}}, "llm: layers: expected a whole number from 1 to 256"),
        ({"dino": {"layers": 256}, "siglip": {"layers": 256}}, "missing"),
        ({"llm": {"dim": 10**6, "heads": 1}}, "expected shape"),
        ({"llm": {"mlp": 10**12}}, "mlp: expected a whole number"),
        ({"vocab_size": 10**6}, "expected shape"),
        ({"vocab_size": HUGE}, "vocab_size: expected a whole number"),
        ({"registers": 10**9}, "registers: expected a whole number"),
        ({"image_size": 4088}, "expected shape"),
        ({"chunk_size": 10**9}, "chunk_size: expected a whole number from 1 to 4096"),
        ({"action_dim": 10**6}, "expected shape"),
        ({"cameras": [{"a": 1}]}, "cameras: expected one or two keys"),
    ],
)
def test_sizes_of_a_vla_policy(vla, changes, message):
    network = json.loads((vla / "config.json").read_text())["network"]
    changes = {k: {**network[k], **v} if isinstance(v, dict) else v for k, v in changes.items()}
    edit(vla, "network", **changes)
    assert message in check_limits(VLAPolicy.from_pretrained, vla)


def test_words_of_a_tokenizer(vla):
    edit(vla, "tokenizer", words=[f"w{i}" for i in range(9 * 10**5)])
    assert "vocab_size" in check_limits(VLAPolicy.from_pretrained, vla)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_blocks": 10**9}, "num_blocks: expected a whole number from 1 to 16384"),
        ({"num_blocks": 16_384, "width": 512}, "expected shape"),
        ({"timesteps": [9] * 10**6}, "timesteps: expected a whole number from 1 to 65536"),
        ({"timesteps": [HUGE]}, "timesteps: expected diffusion timesteps"),
        ({"timesteps": []}, "timesteps: expected a whole number from 1"),
        ({"width": 10**6, "n_head": 1}, "width: expected a whole number from 1 to 512"),
        ({"hidden": 60_000}, "expected shape"),
        ({"hidden": 10**12}, "hidden: expected a whole number"),
        ({"n_layer": 10**9}, "n_layer: expected a whole number from 1 to 64"),
        ({"cond_shape": [60_000, 60_000]}, "expected shape"),
        ({"cond_shape": [2, 5, 5]}, "cond_shape: expected two sizes"),
        ({"n_head": 3}, "width: expected a multiple of n_head=3, got 8"),
    ],
)
def test_sizes_of_a_pruner(pruner, changes, message):
    edit(pruner, "network", **changes)
    assert message in check_limits(load_planner, pruner)


def test_steps_of_a_schedule(tmp_path):
    file = tmp_path / "schedule.json"
    CacheSchedule("by hand", "8d1f", 4, 1, ((0, 2), (0,), (0, 1))).save_pretrained(file)
    file.write_text(
        file.read_text().replace('"num_inference_steps": 4', '"num_inference_steps": 1000000000000')
    )
    assert "num_inference_steps: expected a whole number" in check_limits(read_schedule, file)
