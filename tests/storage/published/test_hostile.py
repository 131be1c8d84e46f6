"""Checkpoints that are hostile, damaged or foreign: each is refused with an error that names it, and nothing runs."""

import os
import pickle
import struct
import zipfile

import dill
import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy
from torchrl_sparse.storage.published.config import KNOWN_NAMES
from torchrl_sparse.storage.published.faults import CheckpointError
from torchrl_sparse.storage.published.inert_pickle import read_pickle

from .checkpoints import low_dim_config, put_config, write_checkpoint


class Attack:
    """Makes a file when it is unpickled by Python."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.system, (f"touch {self.path}",))


class Quiet(Attack):
    """The same through a function that looks harmless."""

    def __reduce__(self):
        return (eval, (f"open({str(self.path)!r}, 'w').close()",))


class AttackOnState(dict):
    """A dict whose state is set by a function of the attacker's choice."""

    def __reduce__(self):
        return (dict, (), None, None, None, os.system)


def put(*path, value):
    def change(payload):
        node = payload
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = value

    return change


def drop(*path):
    def change(payload):
        node = payload
        for key in path[:-1]:
            node = node[key]
        del node[path[-1]]

    return change


def wrong_mask(payload):
    payload["state_dicts"]["ema_model"]["model.mask"] = torch.zeros(10, 10)


def circle(payload):
    payload["cfg"].n_action_steps = "${policy.n_action_steps}"


EMA = ("state_dicts", "ema_model")
BROKEN_PAYLOADS = {
    "no configuration": (drop("cfg"), "bad.ckpt: cfg"),
    "no weights": (drop("state_dicts"), "bad.ckpt: state_dicts"),
    "averaged weights missing": (drop(*EMA), "bad.ckpt: state_dicts"),
    "tensor missing": (drop(*EMA, "model.head.bias"), "bad.ckpt"),
    "tensor of wrong shape": (
        put(*EMA, "model.head.bias", value=torch.zeros(9)),
        "bad.ckpt: model: head.bias",
    ),
    "tensor of integers": (
        put(*EMA, "model.head.bias", value=torch.zeros(10, dtype=torch.int64)),
        "bad.ckpt: model: head.bias",
    ),
    "tensor not finite": (
        put(*EMA, "model.head.bias", value=torch.full((10,), float("nan"))),
        "bad.ckpt: model: head.bias",
    ),
    "weights that are no tensor": (
        put(*EMA, "model.head.bias", value=[0.0] * 10),
        "ckpt: state_dicts: ema_model: model.head.bias",
    ),
    "unknown tensor": (
        put(*EMA, "obs_encoder.w", value=torch.zeros(1)),
        "bad.ckpt",
    ),
    "another mask": (wrong_mask, "bad.ckpt: model.mask"),
    "normaliser without scale": (
        drop(*EMA, "normalizer.params_dict.obs.scale"),
        "bad.ckpt",
    ),
    "normaliser with a zero": (
        put(*EMA, "normalizer.params_dict.action.scale", value=torch.zeros(10)),
        "bad.ckpt: action_scale, action_offset",
    ),
    "another policy": (
        put_config("policy._target_", "diffusion_policy.policy.DiffusionUnetLowdimPolicy"),
        "bad.ckpt: cfg: policy._target_",
    ),
    "another noise schedule": (
        put_config("policy.noise_scheduler.beta_schedule", "linear"),
        "ckpt: cfg: policy.noise_scheduler.beta_schedule",
    ),
    "another prediction": (
        put_config("policy.noise_scheduler.prediction_type", "sample"),
        "cfg: policy.noise_scheduler.prediction_type",
    ),
    "steps without end": (
        put_config("policy.noise_scheduler.num_train_timesteps", 10**15),
        "cfg: policy.noise_scheduler: num_train_timesteps",
    ),
    "heads that are an expression": (
        put_config("policy.model.n_head", '${eval:\'__import__("os").system("true")\'}'),
        "bad.ckpt: cfg: policy.model.n_head",
    ),
    "heads that do not fit": (put_config("policy.model.n_head", 5), "bad.ckpt: n_emb"),
    "references in a circle": (circle, "bad.ckpt: cfg: policy.n_action_steps"),
    "sizes that contradict": (put_config("horizon", 12), "bad.ckpt"),
    "observations not as condition": (
        put_config("policy.model.obs_as_cond", False),
        "bad.ckpt: cfg: policy.model.obs_as_cond",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_PAYLOADS)
def test_a_broken_payload_is_named(published, tmp_path, kind):
    change, message = BROKEN_PAYLOADS[kind]
    path = write_checkpoint(tmp_path / "bad.ckpt", published, change=change)
    with refused(message, CheckpointError):
        DiffusionPolicy.from_diffusion_policy(path)


HOSTILE = {
    "command in the configuration": lambda attack: put("cfg", value=attack),
    "command among the weights": lambda attack: put(*EMA, "model.head.bias", value=attack),
    "command in the optimizer": lambda attack: put("state_dicts", "optimizer", value=attack),
    "command under an unknown key": lambda attack: put("extra", value=attack),
    "command in an inner pickle": lambda attack: put("pickles", "epoch", value=dill.dumps(attack)),
    "function pickled by value": lambda attack: put("pickles", "epoch", value=dill.dumps(lambda: attack)),
}


@pytest.mark.parametrize("attack", [Attack, Quiet])
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_checkpoint_is_refused_and_nothing_runs(published, tmp_path, kind, attack):
    proof = tmp_path / "executed"
    path = write_checkpoint(tmp_path / "bad.ckpt", published, change=HOSTILE[kind](attack(proof)))
    with refused("bad.ckpt", CheckpointError):
        DiffusionPolicy.from_diffusion_policy(path)
    assert not proof.exists()


def test_the_attack_would_work_on_python(tmp_path):
    pickle.loads(pickle.dumps(Attack(tmp_path / "executed")))
    assert (tmp_path / "executed").exists()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_named(checkpoint, tmp_path, share):
    whole = checkpoint.read_bytes()
    (tmp_path / "cut.ckpt").write_bytes(whole[: int(len(whole) * share)])
    with refused("cut.ckpt", CheckpointError):
        DiffusionPolicy.from_diffusion_policy(tmp_path / "cut.ckpt")


def rewrite(source, target, change, compression=zipfile.ZIP_STORED):
    """Copies an archive, its entries as ``change(name, data)`` returns them; None leaves one out."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression) as new:
        for name in old.namelist():
            if (data := change(name, old.read(name))) is not None:
                new.writestr(name, data)
    return target


def replace(ending, data):
    return lambda name, old: data if name.endswith(ending) else old


def cut_pickle(name, data):
    return data[: len(data) // 2] if name.endswith("data.pkl") else data


BROKEN_ARCHIVES = {
    "half a pickle": (cut_pickle, "expected a complete pickle"),
    "no pickle": (replace("data.pkl", None), "expected one entry <name>/data.pkl"),
    "an empty pickle": (replace("data.pkl", b""), "expected a complete pickle"),
    "a pickle that is text": (replace("data.pkl", b"import os\n"), "expected a complete pickle"),
    "storages missing": (lambda n, d: None if "/data/" in n else d, r"data/\d+: expected an entry"),
    "storages too short": (lambda n, d: d[:4] if "/data/" in n else d, r"data/\d+: expected \d+ bytes, got"),
    "another byte order": (replace("byteorder", b"big"), "byteorder: expected little"),
    "numbers instead of a dict": (replace("data.pkl", pickle.dumps(7)), "payload: expected a dict, got int"),
    "stack that runs empty": (replace("data.pkl", b"\x80\x02R."), "expected a complete pickle"),
    "values left over": (replace("data.pkl", b"\x80\x02K\x01K\x02."), "leaves values over"),
    "extension registry": (replace("data.pkl", b"\x80\x02\x82\x01."), "operation EXT1"),
    "classes of the old kind": (replace("data.pkl", b"(ios\nsystem\n."), "operation INST"),
    "length beyond the file": (
        replace("data.pkl", b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"."),
        "expected",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_ARCHIVES)
def test_a_broken_archive_is_named(checkpoint, tmp_path, kind):
    change, message = BROKEN_ARCHIVES[kind]
    path = rewrite(checkpoint, tmp_path / "bad.ckpt", change)
    with pytest.raises(CheckpointError, match=f"bad.ckpt: .*({message})"):
        DiffusionPolicy.from_diffusion_policy(path)


def test_compressed_entries_are_not_unfolded(checkpoint, tmp_path):
    path = rewrite(checkpoint, tmp_path / "bomb.ckpt", lambda name, data: data, zipfile.ZIP_DEFLATED)
    with refused("bomb.ckpt: byteorder", CheckpointError):
        DiffusionPolicy.from_diffusion_policy(path)


def test_flipped_bits_are_noticed(checkpoint, tmp_path):
    data = bytearray(checkpoint.read_bytes())
    with zipfile.ZipFile(checkpoint) as archive:
        storages = [entry for entry in archive.infolist() if "/data/" in entry.filename and entry.file_size]
    for entry in storages:
        name_and_extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        data[entry.header_offset + 30 + sum(name_and_extra)] ^= 1
    (tmp_path / "bad.ckpt").write_bytes(data)
    with refused("bad.ckpt", CheckpointError):
        DiffusionPolicy.from_diffusion_policy(tmp_path / "bad.ckpt")


def test_tensors_reaching_beyond_their_storage_are_refused(published, tmp_path):
    class Beyond:
        def __reduce__(self):
            storage = torch.zeros(4)._typed_storage()
            return (torch._utils._rebuild_tensor_v2, (storage, 1, (10,), (1,), False, {}))

    path = write_checkpoint(
        tmp_path / "bad.ckpt", published, change=put(*EMA, "model.head.bias", value=Beyond())
    )
    with refused("bad.ckpt", CheckpointError):
        DiffusionPolicy.from_diffusion_policy(path)


def test_foreign_files(tmp_path):
    torch.save(torch.nn.Linear(2, 2), tmp_path / "module.pt")
    torch.save({"weight": torch.zeros(2)}, tmp_path / "state.pt")
    torch.save({"cfg": {}}, tmp_path / "legacy.pt", _use_new_zipfile_serialization=False)
    for name, message in (
        ("module.pt", "asks for torch.nn.modules.linear.Linear"),
        ("state.pt", "cfg: expected a configuration"),
        ("legacy.pt", "expected a complete zip archive"),
    ):
        with pytest.raises(CheckpointError, match=f"{name}: .*{message}"):
            DiffusionPolicy.from_diffusion_policy(tmp_path / name)
    with refused("nowhere.ckpt", FileNotFoundError):
        DiffusionPolicy.from_diffusion_policy(tmp_path / "nowhere.ckpt")


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_comes_back_as_python_reads_it(protocol):
    shared = [1, 2]
    data = {"a": (1, -(2**63), 1.5, True, None), "b": [shared, shared, b"\x00\xff", "ü"], 3: {}}
    found = read_pickle(pickle.dumps(data, protocol))
    assert found == data
    assert found["b"][0] is found["b"][1]


@pytest.mark.parametrize("value", [{1, 2}, AttackOnState(a=1), print, 1j, object()])
def test_anything_but_plain_data_is_refused(value):
    with pytest.raises(ValueError, match="expected plain data, got a pickle"):
        read_pickle(pickle.dumps(value))


def test_random_damage_raises_a_value_error_or_nothing(published):
    """Any outcome but data or ValueError would be a hole in the reader."""
    whole = dill.dumps(low_dim_config(published), protocol=2)
    read_pickle(whole, KNOWN_NAMES)
    generator = torch.Generator().manual_seed(0)
    refused = 0
    for _ in range(150):
        broken = bytearray(whole)
        for position in torch.randint(len(whole), (2,), generator=generator).tolist():
            broken[position] = int(torch.randint(256, (), generator=generator))
        try:
            read_pickle(bytes(broken), KNOWN_NAMES)
        except ValueError:
            refused += 1
    assert refused > 30
