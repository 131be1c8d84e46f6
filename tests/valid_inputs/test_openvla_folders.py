"""Folders in OpenVLA-OFT's layout that were trained with other constants than LIBERO's, which no file of theirs says."""

import pytest
import torch
from tensordict import TensorDict

from tests.fixtures.gguf import METADATA, gguf_bytes, llama_tensors, tiny_weights
from tests.refusals import refused
from tests.storage.published import openvla as published
from tests.storage.published.test_openvla_oft import edit, published_crop
from torchrl_sparse import keys
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.storage.language_model import read_language_model
from torchrl_sparse.storage.published.faults import CheckpointError


@pytest.fixture(scope="module")
def weights():
    return published.make_tensors(), *published.make_heads()


@pytest.fixture
def folder(weights, tmp_path):
    published.write(tmp_path, *weights)
    return tmp_path


def load(folder, **options):
    options = {"heads": published.SIZES["heads"], **options}
    return VLAPolicy.from_openvla_oft(folder, dtype=torch.float32, **options)


def statistics(folder, change):
    edit(folder, "dataset_statistics.json", lambda content: change(content["libero_spatial_no_noops"]))


@pytest.mark.parametrize("options", [{"chunk_size": 5}, {"normalization": "bounds"}, {"center_crop": False}])
@torch.no_grad()
def test_what_no_file_says_is_an_argument(weights, folder, options):
    """A plain reading of the same tensors under the constants with which the policy was trained gives its actions."""
    statistics(folder, lambda c: c["action"].update(min=[-3.0] * 6 + [0.0], max=[1.0] * 7))
    statistics(folder, lambda c: c["proprio"].update(min=[-2.0] * 8, max=[6.0] * 8))
    policy = load(folder, **options)
    torch.manual_seed(1)
    image, wrist = torch.randint(256, (2, 1, 3, 28, 28), dtype=torch.uint8)
    state = torch.rand(1, 8) * 4 - 1
    observation = {"image": image, "wrist_image": wrist, "state": state}
    td = policy(TensorDict({"observation": observation, "language_instruction": ["pick up the bowl"]}, [1]))

    ids = torch.tensor([3, 4, 5, 6, 7, 8, 9, 10, 11, 14, 15, 8, 16, 12, 17, 13, 4, 29871])
    pixels = torch.cat([image, wrist])
    pixels = published_crop(pixels) if options.get("center_crop", True) else pixels / 255
    bounds = "normalization" in options
    (state_low, state_range), (low, span) = ((-2, 8), (-3, 4)) if bounds else ((-1, 4), (-0.5, 0.75))
    unit = 2 * (state[0] - state_low) / state_range - 1
    chunk = options.get("chunk_size", 8)
    expected = published.forward(*weights, pixels, unit, ids, chunk)
    expected = torch.cat([(expected[:, :6] + 1) / 2 * span + low, -(2 * expected[:, 6:] - 1).sign()], -1)
    torch.testing.assert_close(td[keys.CHUNK][0], expected, rtol=0, atol=1e-4)
    assert td[keys.CHUNK].shape == (1, chunk, 7)


def resize(folder):
    edit(folder, "config.json", lambda c: c.update(image_resize_strategy="letterbox"))


def other_heads(folder):
    edit(folder, "config.json", lambda c: c["text_config"].update(num_attention_heads=8))


def scaled_rope(folder):
    edit(
        folder,
        "config.json",
        lambda c: c["text_config"].update(rope_scaling={"type": "linear", "factor": 2.0}),
    )


def two_grippers(folder):
    statistics(folder, lambda c: c["action"].update(mask=[True] * 7))


def no_mask(folder):
    statistics(folder, lambda c: c["action"].pop("mask"))


def masked_state(folder):
    statistics(folder, lambda c: c["proprio"].update(mask=[True] * 7 + [False]))


def noisy_actions(folder):
    (folder / "noisy_action_projector--150000_checkpoint.pt").write_bytes(b"")


def noise_predictor(folder):
    path = folder / "action_head--150000_checkpoint.pt"
    head = torch.load(path, weights_only=True)
    renamed = {
        name.replace("module.model.", "module.noise_predictor.mlp_resnet."): value
        for name, value in head.items()
    }
    torch.save(renamed, path)


def discrete(folder):
    (folder / "action_head--150000_checkpoint.pt").unlink()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (resize, "image_resize_strategy: expected resize-naive, got letterbox"),
        (other_heads, "text_config.num_attention_heads: expected 4, got 8"),
        (scaled_rope, "text_config.rope_scaling: expected None"),
        (two_grippers, "action.mask: expected LIBERO's"),
        (no_mask, "action.mask: expected LIBERO's"),
        (masked_state, "proprio.mask: expected all true"),
        (noisy_actions, "got a diffusion head, which is not supported"),
        (noise_predictor, "got a diffusion head, which is not supported"),
        (discrete, "expected exactly one file action_head.*a policy without is not supported"),
    ],
)
def test_what_is_not_liberos_is_refused(folder, change, message):
    """Such folders are valid, and are other policies: read as LIBERO's, their actions would be wrong."""
    change(folder)
    with pytest.raises(CheckpointError, match=message):
        load(folder)


def test_two_arms_are_refused(weights, tmp_path):
    """ALOHA's constants: 14 numbers of a state and of an action."""
    width = published.SIZES["llm"]
    head = {name: value for name, value in weights[1].items() if "fc2" not in name}
    head |= {
        f"module.model.fc2.{name}": torch.zeros(14, *shape)
        for name, shape in (("weight", (width,)), ("bias", ()))
    }
    published.write(tmp_path, weights[0], head, weights[2] | {"module.fc1.weight": torch.zeros(width, 14)})
    with refused(tmp_path.name, CheckpointError):
        load(tmp_path)


@pytest.mark.parametrize(
    ("options", "entry"),
    [
        ({"cameras": 3}, "cameras"),
        ({"heads": (16, 32)}, "heads"),
        ({"normalization": "normal"}, "normalization"),
        ({"normalization": "bounds"}, "dataset_statistics.json"),
        ({"chunk_size": 0}, "chunk_size"),
    ],
)
def test_an_argument_that_a_folder_cannot_have_is_named(folder, options, entry):
    """None of them is taken for another value without a word."""
    with refused(entry):
        load(folder, **options)


def test_arguments_of_the_other_layout_are_not_passed_over(folder, tmp_path):
    """A folder of ours says everything itself, and a published one is of one architecture."""
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny()))
    policy.save_pretrained(tmp_path / "ours")
    with refused("chunk_size"):
        VLAPolicy.from_pretrained(tmp_path / "ours", chunk_size=5)
    with refused("config"):
        VLAPolicy.from_pretrained(folder, config=VLAConfig.tiny())


@pytest.mark.parametrize("name", ["llama.rope.dimension_count", "llama.attention.key_length"])
def test_a_language_model_that_turns_a_part_of_each_head_is_named(tmp_path, name):
    """GGUF files may say how much of a head its rotary embeddings turn; the decoder here turns all of it."""
    for size in (8, 4):
        tensors = llama_tensors(tiny_weights())
        (tmp_path / f"{size}.gguf").write_bytes(gguf_bytes(METADATA | {name: size}, tensors))
    assert read_language_model(tmp_path / "8.gguf").sizes["kv_heads"] == 2
    with refused(f"4.gguf: {name}"):
        read_language_model(tmp_path / "4.gguf")
