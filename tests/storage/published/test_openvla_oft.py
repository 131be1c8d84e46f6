"""Import of a folder in the published layout, against a plain reading of the same tensors."""

import json
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from tests.refusals import refused
from tests.storage.published import openvla as published
from torchrl_sparse import keys
from torchrl_sparse.blocks.planner import tensors_fingerprint
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.published.faults import CheckpointError
from torchrl_sparse.storage.vla import VLASource


@pytest.fixture(scope="module")
def weights():
    return published.make_tensors(), *published.make_heads()


@pytest.fixture
def folder(weights, tmp_path):
    published.write(tmp_path, *weights)
    return tmp_path


def load(folder, **options):
    return VLAPolicy.from_openvla_oft(folder, heads=published.SIZES["heads"], dtype=torch.float32, **options)


@torch.no_grad()
def test_actions_are_those_of_the_plain_reading(weights, folder):
    policy = load(folder, unnorm_key="libero_spatial")
    torch.manual_seed(1)
    image, wrist = torch.randint(256, (2, 1, 3, 28, 28), dtype=torch.uint8)
    state = torch.rand(1, 8) * 4 - 1
    texts = ["Pick up the bowl"]
    observation = {"image": image, "wrist_image": wrist, "state": state}
    td = policy(TensorDict({"observation": observation, "language_instruction": texts}, [1]))

    # In : What action should the robot take to | pick up the bowl | ? \n Out :, and Llama's empty word
    ids = torch.tensor([3, 4, 5, 6, 7, 8, 9, 10, 11, 14, 15, 8, 16, 12, 17, 13, 4, 29871])
    cropped = published_crop(torch.cat([image, wrist]))
    expected = published.forward(*weights, cropped, (state[0] - 1) / 2, ids)
    expected = torch.cat([(expected[:, :6] + 1) / 2 * 0.75 - 0.5, -(2 * expected[:, 6:] - 1).sign()], -1)
    torch.testing.assert_close(td[keys.CHUNK][0], expected, rtol=0, atol=2e-5)
    assert expected[:, :6].std() > 0.05


def published_crop(images):
    """TensorFlow's crop_and_resize of the central 90 % by area, pixel by pixel, as u8 and back in [0, 1]."""
    side, size = 0.9**0.5, images.shape[-1]
    place = ((1 - side) / 2 + torch.arange(size) / (size - 1) * side) * (size - 1)
    low = place.floor().long().clamp(max=size - 2)
    share = place - low
    images = images.float() / 255
    rows = images[..., low, :] * (1 - share)[:, None] + images[..., low + 1, :] * share[:, None]
    both = rows[..., low] * (1 - share) + rows[..., low + 1] * share
    return (both * 255.5).clamp(0, 255).to(torch.uint8).float() / 255


def test_sizes_are_read_from_the_weights(folder):
    config = load(folder).network.config
    assert (config.dino.dim, config.siglip.dim, config.llm.dim, config.siglip.mlp) == (32, 24, 48, 40)
    assert (config.dino.layers, config.llm.layers, config.registers, config.image_size) == (3, 3, 4, 28)
    assert load(folder, cameras=1).network.config.cameras == (keys.IMAGE,)


@torch.no_grad()
def test_what_was_imported_can_be_saved(folder, tmp_path):
    policy = load(folder)
    policy.save_pretrained(tmp_path / "ours")
    again = type(policy).from_pretrained(tmp_path / "ours")
    assert again.source == policy.source == VLASource("libero_spatial", images="openvla_oft")
    assert again.tokenizer.definition is not None
    assert torch.equal(again.normalizer.action_low, policy.normalizer.action_low)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@torch.no_grad()
def test_weights_keep_their_type_and_stay_in_the_file(weights, tmp_path, dtype):
    parts = ({name: value.to(dtype) for name, value in part.items()} for part in weights)
    published.write(tmp_path, *parts)
    policy = VLAPolicy.from_pretrained(tmp_path, heads=published.SIZES["heads"])
    assert {value.dtype for value in policy.network.parameters()} == {dtype}
    shards = {str(path.resolve()) for path in tmp_path.glob("*.safetensors")}
    embedding = policy.network.decoder.llama.embed_tokens.weight
    layers = [layer.mlp.up_proj.weight for layer in policy.network.decoder.llama.layers]
    assert {mapped_file(weight) for weight in (embedding, *layers)} <= shards
    observation = {name: torch.zeros(1, 3, 28, 28, dtype=torch.uint8) for name in ("image", "wrist_image")}
    observation |= {"state": torch.zeros(1, 8)}
    td = policy(TensorDict({"observation": observation, "language_instruction": ["pick"]}, [1]))
    assert td[keys.CHUNK].isfinite().all()
    assert tensors_fingerprint(policy.state_dict()) != tensors_fingerprint(load(tmp_path).state_dict())


def mapped_file(tensor):
    """The file that holds a tensor's memory, None where it is the process' own."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, *_, last = line.split(maxsplit=5)
        first, end = (int(address, 16) for address in span.split("-"))
        if first <= tensor.data_ptr() < end:
            return last if last.startswith("/") else None


def edit(folder, name, change):
    content = json.loads((folder / name).read_text())
    change(content)
    (folder / name).write_text(json.dumps(content))


def drop_shard(folder):
    (folder / "model-00002-of-00002.safetensors").unlink()


def cut_shard(folder):
    path = folder / "model-00002-of-00002.safetensors"
    path.write_bytes(path.read_bytes()[:1000])


def second_head(folder):
    (folder / "action_head--50000_checkpoint.pt").write_bytes(b"")


def escape(folder):
    edit(folder, "model.safetensors.index.json", lambda c: c["weight_map"].update(x="../other.safetensors"))


def other_model(folder):
    edit(folder, "config.json", lambda c: c.update(model_type="llava"))


def other_norm(folder):
    edit(folder, "config.json", lambda c: c["text_config"].update(rms_norm_eps=1e-5))


def two_data_sets(folder):
    edit(folder, "dataset_statistics.json", lambda c: c.update(other=published.statistics()))


def short_statistics(folder):
    edit(folder, "dataset_statistics.json", lambda c: c["libero_spatial_no_noops"]["proprio"].pop("q99"))


def film(folder):
    (folder / "vision_backbone--150000_checkpoint.pt").write_bytes(b"")


def endless_head(folder):
    """A weight that repeats one number: nothing of it is in the file."""
    path = folder / "action_head--150000_checkpoint.pt"
    weights = torch.load(path, weights_only=True)
    torch.save(weights | {"module.model.fc2.weight": torch.zeros(1).expand(10**9, 48)}, path)


def endless_image(folder):
    edit(folder, "config.json", lambda c: c.update(image_sizes=[10**9, 10**9]))


def image_of_lists(folder):
    edit(folder, "config.json", lambda c: c.update(image_sizes=[[28], [28]]))


def text_of_no_config(folder):
    edit(folder, "config.json", lambda c: c.update(text_config=[1]))


def ragged_statistics(folder):
    edit(
        folder,
        "dataset_statistics.json",
        lambda c: c["libero_spatial_no_noops"]["action"].update(mask=[[1], []]),
    )


def a_thousand_layers(folder):
    path = folder / "model-00001-of-00002.safetensors"
    block = {f"vision_backbone.featurizer.blocks.{i}.more": torch.zeros(1) for i in range(1000)}
    save_file(load_file(path) | block, path)


def whole_numbers(folder):
    path = folder / "model-00001-of-00002.safetensors"
    save_file({name: value.int() for name, value in load_file(path).items()}, path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            endless_head,
            r"checkpoint.pt: expected a file of tensors, got: expected a tensor within its storage of 1",
        ),
        (endless_image, r"image_size: expected a whole number from 1 to 4096"),
        (image_of_lists, r"expected a checkpoint, got TypeError"),
        (text_of_no_config, r"expected a checkpoint, got AttributeError"),
        (ragged_statistics, r"expected .*"),
        (a_thousand_layers, r"layers: expected a whole number from 1 to 256, got 1000"),
        (whole_numbers, r"expected a type of .*'F16'.*got I32"),
        (drop_shard, r"expected a file .*model-00002-of-00002"),
        (cut_shard, r"model-00002-of-00002.safetensors: expected a complete safetensors file"),
        (second_head, r"expected exactly one file action_head\*checkpoint\*, got \['action_head--150000"),
        (escape, r"expected file names in this folder"),
        (other_model, r"model_type: expected 'openvla', got 'llava'"),
        (other_norm, r"rms_norm_eps: expected 1e-06, got 1e-05"),
        (two_data_sets, r"unnorm_key: expected one of \['libero_spatial_no_noops', 'other'\], got None"),
        (short_statistics, r"dataset_statistics.json: expected q01 and q99.*q99"),
        (film, r"expected a checkpoint without FiLM"),
    ],
)
def test_damage_is_named(folder, damage, message):
    damage(folder)
    with pytest.raises((FileNotFoundError, CheckpointError), match=message):
        load(folder)


def test_a_missing_tensor_is_named(weights, tmp_path):
    tensors = dict(weights[0])
    del tensors["vision_backbone.featurizer.blocks.1.ls2.scale_factor"]
    published.write(tmp_path, tensors, *weights[1:])
    with refused(tmp_path.name):
        load(tmp_path)


class Bomb:
    def __reduce__(self):
        return (SystemExit, ("executed",))


def test_nothing_is_executed(folder):
    (folder / "action_head--150000_checkpoint.pt").write_bytes(pickle.dumps({"module.x": Bomb()}, protocol=2))
    with refused("action_head--150000_checkpoint.pt"):
        load(folder)
