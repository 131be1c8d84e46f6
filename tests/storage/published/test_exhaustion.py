"""Small checkpoints that ask for much: each is read or refused within the limits of `tests.limits`."""

import pickle
import zipfile
from dataclasses import replace

import pytest
import torch

from tests.limits import check_limits
from torchrl_sparse import DiffusionPolicy

from .archives import entry, true_payload, write_archive
from .checkpoints import LowDimPolicy

EMA = ("state_dicts", "ema_model")


def refusal(path):
    return check_limits(read, path)


def read(path):
    """What users do with a checkpoint: import it, and keep it."""
    DiffusionPolicy.from_diffusion_policy(path).save_pretrained(path.parent / "ours")


@pytest.fixture
def write(tmp_path):
    def write(payload, records):
        return write_archive(tmp_path / "small.ckpt", payload, records)

    return write


def put(payload, *path, value):
    for key in path[:-1]:
        payload = payload[key]
    payload[path[-1]] = value


def shapes(**sizes):
    with torch.device("meta"):
        state = LowDimPolicy(**sizes).state_dict()
    return {name: tuple(value.shape) for name, value in state.items() if value.numel()}


def test_an_honest_checkpoint_of_this_kind_is_read(write):
    assert refusal(write(*true_payload())) is None


@pytest.mark.parametrize(
    "sizes", [{"n_emb": 8192}, {"horizon": 4000}, {"obs_dim": 10**7}, {"action_dim": 10**6}]
)
def test_tensors_larger_than_their_records(write, sizes):
    payload, _ = true_payload()
    put(payload, *EMA, value={name: entry(shape) for name, shape in shapes(**sizes).items()})
    assert "data/0: expected" in refusal(write(payload, {"0": b"1234"}))


def test_tensors_that_share_one_record(write):
    payload, _ = true_payload()
    record = torch.zeros(4 * 700 * 700).numpy().tobytes()
    tensors = {
        name: entry(shape, numel=4 * 700 * 700) for name, shape in shapes(n_emb=700, n_layer=64).items()
    }
    put(payload, *EMA, value=tensors)
    payload["cfg"]["policy"]["model"] |= {"n_emb": 700, "n_layer": 64}
    assert "expected tensors with storages of their own" in refusal(write(payload, {"0": record}))


def test_a_directory_that_lies_about_a_record(write):
    payload, _ = true_payload()
    put(payload, *EMA, value={name: entry(shape) for name, shape in shapes(n_emb=8192).items()})
    path = write(payload, {"0": b"1234"})
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("archive/data/0")
    data = bytearray(path.read_bytes())
    place = data.rfind(b"archive/data/0") - 46  # its entry in the directory
    for offset in (20, 24):  # compressed size and size
        data[place + offset : place + offset + 4] = (4 * 8192).to_bytes(4, "little")
    assert info.file_size == 4
    path.write_bytes(data)
    assert "data/0: " in refusal(path)


@pytest.mark.parametrize("causal", [True, False])
def test_a_horizon_whose_mask_is_far_larger_than_the_file(write, causal):
    payload, records = true_payload(n_emb=8, n_head=1, n_layer=1)
    put(payload, *EMA, "model.pos_emb", value=entry((1, 60_000, 8), "long"))
    if not causal:
        for name in ("model.mask", "model.memory_mask"):
            del payload["state_dicts"]["ema_model"][name]
    put(payload, "cfg", "horizon", value=60_000)
    records["long"] = bytes(4 * 60_000 * 8)
    assert "horizon: expected a whole number from 1 to 4096, got 60000" in refusal(write(payload, records))


def test_thousands_of_layers(write):
    payload, records = true_payload(n_emb=8, n_head=1, n_layer=1)
    tensors = payload["state_dicts"]["ema_model"]
    first = {name: value for name, value in tensors.items() if ".layers.0." in name}
    for layer in range(1, 3000):
        tensors |= {name.replace(".0.", f".{layer}.", 1): value for name, value in first.items()}
    assert "n_layer: expected a whole number from 1 to 256, got 3000" in refusal(write(payload, records))


@pytest.mark.parametrize("place", ["shape", "stride", "numel"])
def test_integers_of_eighty_thousand_bits(write, place):
    huge = 1 << 80_000
    payload, records = true_payload()
    whole = payload["state_dicts"]["ema_model"]["model.head.bias"]
    change = {
        "shape": {"shape": (huge,)},
        "stride": {"stride": (huge,)},
        "numel": {"storage": replace(whole.storage, numel=huge)},
    }
    put(payload, *EMA, "model.head.bias", value=replace(whole, **change[place]))
    assert "at most 64 bits, got one of 80001" in refusal(write(payload, records))


def test_a_shape_of_a_hundred_thousand_axes(write):
    payload, records = true_payload()
    axes = (2**62,) * 100_000
    whole = payload["state_dicts"]["ema_model"]["model.head.bias"]
    put(payload, *EMA, "model.head.bias", value=replace(whole, shape=axes, stride=axes))
    assert "expected a tensor as storage" in refusal(write(payload, records))


def test_a_string_that_is_encoded_again_and_again(write):
    text = b"X" + (3_000_000).to_bytes(4, "little") + b"a" * 3_000_000 + b"q\x00"
    encode = b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R"
    payload = b"\x80\x02" + text + b"](" + encode * 1500 + b"e\x86."
    assert "makes more bytes than it has" in refusal(write(payload, {}))


def nested_pairs(leaf):
    for _ in range(60):
        leaf = (leaf, leaf)
    return leaf


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (("cfg", "task", "obs_keys"), "expected plain values, got tuple"),
        (("cfg", "task", "name"), "expected plain values, got tuple"),
        (("pickles", "epoch"), "epoch: expected a whole number, got tuple"),
    ],
)
def test_pairs_of_pairs(write, path, message):
    payload, records = true_payload()
    put(payload, *path, value=nested_pairs("x"))
    assert message in refusal(write(payload, records))


def test_lists_of_lists_and_an_epoch_in_its_own_pickle(write):
    shared = ["x"]
    for _ in range(25):
        shared = [shared, shared]
    payload, records = true_payload()
    put(payload, "cfg", "task", "obs_keys", value=shared)
    assert "task.obs_keys: expected at most 64 names" in refusal(write(payload, records))
    put(payload, "cfg", "task", "obs_keys", value=["object"])
    put(payload, "pickles", "epoch", value=pickle.dumps(nested_pairs(1)))
    assert "epoch: expected a whole number, got tuple" in refusal(write(payload, records))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a" * 5_000_000] * 60, "expected at most 64 names"),
        (["object"] * 200_000, "expected at most 64 names"),
        (["object", 3], "expected at most 64 names"),
        ("object", "expected at most 64 names, got str"),
    ],
)
def test_names_that_are_long_or_many(write, names, message):
    payload, records = true_payload()
    put(payload, "cfg", "task", "obs_keys", value=names)
    assert message in refusal(write(payload, records))


def test_references_that_multiply(write):
    payload, records = true_payload()
    levels = {
        f"r{i}": {"down": f"${{r{i + 1}.down.down.down.up}}", "up": f"${{r{i - 1}}}"} for i in range(28)
    }
    payload["cfg"] |= {**levels, "r28": {"down": "${r28}", "up": "${r27}"}}
    put(payload, "cfg", "n_action_steps", value="${r0.down.down.down}")
    refusal(write(payload, records))


def test_a_reference_with_a_million_levels(write):
    payload, records = true_payload()
    put(payload, "cfg", "n_action_steps", value="${" + "a." * 2_000_000 + "a}")
    assert "expected a path of at most 32 levels" in refusal(write(payload, records))


@pytest.mark.parametrize("operation", [b"]", b"N", b"](e", b"K\x01", b"Nq\x00h\x00"])
def test_millions_of_operations(write, operation):
    body = operation * (9_000_000 // len(operation))
    assert "at most 1000000 operations" in refusal(write(b"\x80\x02N(" + body + b"t.", {}))


OBSERVATIONS = ("cfg", "policy", "shape_meta", "obs")


@pytest.mark.parametrize(
    ("observations", "message"),
    [
        ({"state": {"shape": [10**12]}, "image": {"shape": [3, 84, 84], "type": "rgb"}}, "obs_encoder"),
        ({f"camera{i}": {"shape": [3, 84, 84], "type": "rgb"} for i in range(50_000)}, "at most 64 names"),
        ({3: {"shape": [3]}}, "at most 64 names"),
        ({"state": {"shape": [3] * 10**5}}, "expected an image or one axis"),
    ],
)
def test_observations_without_end(write, observations, message):
    payload, records = true_payload()
    target = "diffusion_transformer_hybrid_image_policy.DiffusionTransformerHybridImagePolicy"
    policy = payload["cfg"]["policy"]
    denoiser = {
        name: policy["model"][name] for name in ("n_layer", "n_head", "n_emb", "n_cond_layers", "causal_attn")
    }
    for name in ("model", "obs_dim", "action_dim"):
        policy.pop(name, None)
    policy |= denoiser | {"_target_": target, "obs_encoder_group_norm": True, "eval_fixed_crop": True}
    put(payload, *OBSERVATIONS[:-1], value={"obs": observations})
    assert message in refusal(write(payload, records))


def test_a_hundred_thousand_entries(tmp_path):
    path = tmp_path / "small.ckpt"
    with zipfile.ZipFile(path, "w") as archive:
        for number in range(95_000):
            archive.writestr(str(number), b"")
    assert "expected one entry <name>/data.pkl" in refusal(path)


def test_a_deep_pickle(write):
    deep = b"](" * 200_000 + b"e" * 200_000
    pickled = b"\x80\x02}X\x03\x00\x00\x00cfg" + deep + b"s."
    assert "cfg: expected a configuration" in refusal(write(pickled, {}))
