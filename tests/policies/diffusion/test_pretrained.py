"""Policies on disk: round trips, and files that are wrong in many ways."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.policies.diffusion.test_policy import request
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Sampler, keys


@pytest.fixture
def folder(policy, tmp_path):
    policy.save_pretrained(tmp_path)
    return tmp_path


def test_round_trip_at_half_precision(policy, folder):
    loaded = DiffusionPolicy.from_pretrained(folder)
    assert loaded.sampler.config == policy.sampler.config
    assert loaded.network.config == policy.network.config
    for name, value in policy.network.state_dict().items():
        assert torch.equal(loaded.network.state_dict()[name], value.half().float())
    assert torch.equal(loaded.normalizer.action_scale, policy.normalizer.action_scale)
    loaded.save_pretrained(folder / "again")
    again = DiffusionPolicy.from_pretrained(folder / "again")
    assert torch.equal(again(request(2))[keys.CHUNK], loaded(request(2))[keys.CHUNK])


def test_weights_of_the_cameras_have_their_own_file(make_image_policy, tmp_path):
    policy = make_image_policy()
    policy.save_pretrained(tmp_path)
    loaded, file = DiffusionPolicy.from_pretrained(tmp_path), tmp_path / "vision.safetensors"
    for name, value in load_file(file).items():
        assert torch.equal(value, policy.vision.state_dict()[name].half())
        assert torch.equal(loaded.vision.state_dict()[name], value.float())
    assert loaded.fingerprint == policy.fingerprint
    wrong = {**load_file(file), "encoders.image.linear.bias": torch.zeros(3)}
    save_file(wrong, file)
    with refused("vision.safetensors: encoders.image.linear.bias"):
        DiffusionPolicy.from_pretrained(tmp_path)
    file.unlink()
    with refused("vision.safetensors", FileNotFoundError):
        DiffusionPolicy.from_pretrained(tmp_path)


def change_tensors(folder, change):
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors")


def change_config(folder, change):
    config = json.loads((folder / "config.json").read_text())
    change(config)
    (folder / "config.json").write_text(json.dumps(config))


TENSOR_FAULTS = {
    "missing": (lambda t: t.pop("network.head.bias"), "model.safetensors"),
    "extra": (lambda t: t.update({"network.more": torch.zeros(1)}), "model.safetensors"),
    "foreign": (lambda t: t.update({"optimizer": torch.zeros(1)}), "model.safetensors"),
    "shape": (
        lambda t: t.update({"network.head.bias": torch.zeros(9)}),
        "model.safetensors: network.head.bias",
    ),
    "nan": (
        lambda t: t.update({"network.head.bias": torch.full((4,), float("nan"))}),
        "model.safetensors: network.head.bias",
    ),
    "integers": (
        lambda t: t.update({"network.head.bias": torch.zeros(4, dtype=torch.int32)}),
        "model.safetensors: network.head.bias",
    ),
    "bytes": (
        lambda t: t.update({"normalizer.state_scale": torch.ones(5).byte()}),
        "model.safetensors: normalizer.state_scale",
    ),
    "no scale": (
        lambda t: t.update({"normalizer.state_scale": torch.zeros(5)}),
        "normalizer: state_scale, state_offset",
    ),
    "normalizer": (lambda t: t.pop("normalizer.state_scale"), "model.safetensors"),
}


@pytest.mark.parametrize("fault", TENSOR_FAULTS)
def test_wrong_tensors_are_named(folder, fault):
    change, entry = TENSOR_FAULTS[fault]
    change_tensors(folder, change)
    with refused(entry):
        DiffusionPolicy.from_pretrained(folder)


CONFIG_FAULTS = {
    "format": (
        lambda c: c.update(format="other/1"),
        "config.json: format",
    ),
    "field": (lambda c: c.pop("schedule"), "config.json: schedule"),
    "unknown argument": (lambda c: c["network"].update(n_experts=3), "config.json"),
    "size": (lambda c: c["network"].update(n_emb=30), "config.json: network: n_emb"),
    "timesteps": (
        lambda c: c["schedule"].update(kind="ddim", num_inference_steps=2, timesteps=[10, 90]),
        "config.json: schedule: timesteps",
    ),
    "depth": (lambda c: c["network"].update(n_layer=3), "model.safetensors"),
    "warm start": (
        lambda c: c.update(warm_start=c["schedule"]["num_inference_steps"]),
        "config.json: warm_start",
    ),
    "no warm step": (lambda c: c.update(warm_start=0), "config.json: warm_start"),
    "kind of warm start": (lambda c: c.update(warm_start=True), "config.json: warm_start"),
}


@pytest.mark.parametrize("fault", CONFIG_FAULTS)
def test_wrong_configs_are_named(folder, fault):
    change, entry = CONFIG_FAULTS[fault]
    change_config(folder, change)
    with refused(entry):
        DiffusionPolicy.from_pretrained(folder)


def test_chosen_timesteps_are_kept(policy, tmp_path):
    policy.sampler = Sampler("ddim", timesteps=[90, 10])
    policy.save_pretrained(tmp_path)
    assert DiffusionPolicy.from_pretrained(tmp_path).sampler.name == "ddim_90_10"


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_truncated_and_missing_files_are_named(folder, name):
    file = folder / name
    file.write_bytes(file.read_bytes()[:60])
    with refused(name):
        DiffusionPolicy.from_pretrained(folder)
    file.unlink()
    with refused(name, FileNotFoundError):
        DiffusionPolicy.from_pretrained(folder)


def test_a_pickle_in_place_of_the_weights_executes_nothing(folder, tmp_path):
    class Attack:
        def __reduce__(self):
            return (open, (str(tmp_path / "executed"), "w"))

    torch.save(Attack(), folder / "model.safetensors")
    with refused("model.safetensors"):
        DiffusionPolicy.from_pretrained(folder)
    assert not (tmp_path / "executed").exists()


def test_a_failed_save_leaves_the_old_files(policy, folder, monkeypatch):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr("torchrl_sparse.storage.tensors.save_file", fail)
    with pytest.raises(OSError, match="disk full"):
        policy.save_pretrained(folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
