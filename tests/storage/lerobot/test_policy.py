"""Policies of LeRobot answer as LeRobot does, whatever engine runs them, and stay what they are in this library's files."""

import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from tests.lerobot_answers import MOST, TASKS, error, observations
from tests.refusals import refused
from tests.storage.lerobot.conftest import FIXTURES, NAMES
from torchrl_sparse import ChunkExecutor, DiffusionPolicy, Sampler
from torchrl_sparse.blocks.uniform import Uniform

pytestmark = pytest.mark.filterwarnings("ignore:num_inference_steps=3")


@pytest.mark.parametrize("engine", ["reference", "torch"])
@pytest.mark.parametrize("name", NAMES)
def test_a_policy_answers_as_lerobot_does(name, engine):
    policy = DiffusionPolicy.from_lerobot(FIXTURES / name, engine=engine)
    assert error(FIXTURES / name, policy) <= MOST


def test_its_condition_is_lerobots_with_the_state_last():
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    found = policy(observations(FIXTURES / "flow", policy))["diffusion", "cond"]
    expected = load_file(FIXTURES / "flow" / "reference.safetensors")["cond"].unflatten(1, (2, -1))
    torch.testing.assert_close(found, expected.roll(-5, dims=-1), atol=2e-6, rtol=0)


def test_auto_passes_over_the_native_engine_and_says_why():
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    assert policy.engine_info().startswith("torch: ")
    assert "AdaLNTransformer" in policy.engine_info()
    policy.engine = "native"
    with refused("native engine"):
        policy.engine_info()


def test_what_it_says_of_itself():
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    assert policy.source["cameras"] == {
        "top": "observation.images.top",
        "wrist": "observation.images.wrist",
    }
    assert policy.source["n_action_steps"] == 5
    assert policy.source["state"] == {"observation.state": 5}
    assert policy.num_blocks == 4
    assert policy.chunk_shape == (7, 3)
    assert "top, uint8 [18, 20, 3]" in policy.describe()


def test_saved_here_it_answers_alike_and_knows_the_instructions_that_it_has_seen(tmp_path):
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "mean_std")
    td = observations(FIXTURES / "mean_std", policy)
    expected = policy(
        td.set(("episode", "seed"), torch.arange(3)[:, None]).set(
            ("episode", "step"), torch.zeros(3, 1).long()
        )
    )
    policy.save_pretrained(tmp_path / "saved", half=False)
    again = DiffusionPolicy.from_pretrained(tmp_path / "saved")
    assert again.fingerprint == policy.fingerprint
    assert sorted(again.source["instructions"]) == sorted(set(TASKS))
    found = again(td.select("history", "language_instruction", "episode"))
    torch.testing.assert_close(
        found["vla_action", "chunk"], expected["vla_action", "chunk"], atol=1e-5, rtol=0
    )


def test_a_mask_of_two_columns_a_layer_runs_alike_in_every_engine_also_after_saving(tmp_path):
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    policy.plan = Uniform(3)
    td = observations(FIXTURES / "flow", policy)
    cond = policy(td)["diffusion", "cond"]
    mask = policy.plan.masks(cond)
    assert mask.shape == (3, 7, 4)
    noise = torch.randn(3, 7, 8, 3)
    answers = {}
    for engine in ("reference", "torch"):
        policy.engine = engine
        answers[engine] = policy.denoise(noise, cond, mask)
    torch.testing.assert_close(answers["torch"], answers["reference"], atol=1e-5, rtol=0)
    policy.save_pretrained(tmp_path)
    assert DiffusionPolicy.from_pretrained(tmp_path).plan.schedule.block_types == ("SA", "FFN")


def test_few_steps_of_flow_at_chosen_times():
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    policy.sampler = policy.sampler.variant_named("flow_0_0.4")
    assert policy.sampler.timesteps.tolist() == pytest.approx([0.0, 0.4])
    with refused("prediction"):
        policy.sampler.variant("ddim", 10)
    with refused("sampler"):
        policy.sampler = Sampler("ddim", 10)


def test_one_instruction_does_for_calls_without_one():
    policy = DiffusionPolicy.from_lerobot(FIXTURES / "flow", task=TASKS[0])
    given = observations(FIXTURES / "flow", policy)
    told = policy(given.clone())["diffusion", "cond"]
    untold = policy(given.exclude("language_instruction"))["diffusion", "cond"]
    assert torch.equal(told[0], untold[0])
    assert not torch.equal(told[1], untold[1])
    assert policy.source["instruction"] == TASKS[0]
    with refused("language_instruction"):
        DiffusionPolicy.from_lerobot(FIXTURES / "flow")(given.exclude("language_instruction"))


def test_tokens_stand_for_a_tokenizer_that_is_not_there(folder):
    (folder / "clip" / "tokenizer.json").unlink()
    tokens = {"push the red cube": [0, 2, 3, 4, 5, 1], "pick it": [0, 6, 7, 1, 1, 1]}
    assert error(folder, DiffusionPolicy.from_lerobot(folder, tokens=tokens)) <= MOST
    with refused("language_instruction"):
        error(folder, DiffusionPolicy.from_lerobot(folder))


def test_a_frame_that_was_encoded_before_keeps_its_features_but_not_its_instruction():
    policy = DiffusionPolicy.from_pretrained(FIXTURES / "flow")
    td = observations(FIXTURES / "flow", policy)
    first = policy(td.clone())
    known = first.select(("diffusion", "frame_features")).set(("control", "elapsed"), torch.ones(3, 1).long())
    told = td.clone().exclude("language_instruction").update(known).set("language_instruction", "pick it")
    found = policy(told)["diffusion", "cond"]
    fresh = policy(td.clone().exclude("language_instruction").set("language_instruction", "pick it"))
    features = policy.vision.feature_dim
    torch.testing.assert_close(found[:, 0, :features], first["diffusion", "cond"][:, 1, :features])
    assert torch.equal(found[..., features:], fresh["diffusion", "cond"][..., features:])


def test_images_of_whole_numbers_are_those_of_shares():
    policy = DiffusionPolicy.from_lerobot(FIXTURES / "flow", task="pick it")
    images = torch.randint(256, (1, 2, 3, 18, 20), dtype=torch.uint8)
    state = policy.normalizer.state_shift.expand(1, 2, 5)
    as_bytes = TensorDict({"history": {"state": state, "top": images, "wrist": images}}, [1])
    as_shares = TensorDict({"history": {"state": state, "top": images / 255, "wrist": images / 255}}, [1])
    assert torch.equal(policy(as_bytes)["diffusion", "cond"], policy(as_shares)["diffusion", "cond"])


def test_it_acts_on_plain_observations_of_its_own_cameras():
    policy = DiffusionPolicy.from_lerobot(FIXTURES / "flow", task="pick it")
    actor = ChunkExecutor(policy, n_action_steps=policy.source["n_action_steps"])
    image = np.zeros((18, 20, 3), np.uint8)
    observation = {"state": policy.normalizer.state_shift.numpy(), "top": image, "wrist": image}
    assert actor.act(observation).shape == (3,)
    with refused("top"):
        actor.act(observation | {"top": image.astype(np.float32)})


def change(file, **entries):
    """Write other entries into a JSON file; of processors, into the configuration of one step."""
    content = json.loads(file.read_text())
    for name, value in entries.items():
        place, _, key = name.rpartition("__")
        where = (
            content
            if not place
            else next(s for s in content["steps"] if s["registry_name"] == place)["config"]
        )
        where[key] = value
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        ({"type": "act"}, "type"),
        ({"integration_method": "rk4"}, "integration_method"),
        ({"beta_schedule": "linear"}, "beta_schedule"),
        ({"use_peft": True}, "use_peft"),
        ({"gradient_checkpointing": False}, "gradient_checkpointing"),
        ({"num_integration_steps": 0}, "num_integration_steps"),
        ({"image_crop_shape": [12, 12]}, "image_size"),
        ({"hidden_dim": 18}, "model.safetensors"),
        ({"num_layers": 3}, "model.safetensors"),
        ({"vision_encoder_name": "org/clip-of-theirs"}, "vision_encoder_name"),
        ({"output_features": {"action": {"type": "ACTION", "shape": [4]}}}, "action.min"),
        ({"output_features": {"hand": {"type": "ACTION", "shape": [3]}}}, "output_features"),
    ],
)
def test_entries_that_are_not_supported_are_named(folder, entries, entry):
    change(folder / "config.json", **entries)
    with pytest.raises(ValueError, match=entry) as raised:
        DiffusionPolicy.from_lerobot(folder)
    assert "\n" not in str(raised.value)
    assert str(folder) in str(raised.value)


@pytest.mark.parametrize(
    ("entries", "entry"),
    [
        ({"rename_observations_processor__rename_map": {"a": "b"}}, "rename_map"),
        ({"tokenizer_processor__padding_side": "left"}, "padding_side"),
        ({"normalizer_processor__norm_map": {"STATE": "SQUARE"}}, "norm_map"),
    ],
)
def test_processors_that_are_not_supported_are_named(folder, entries, entry):
    change(folder / "policy_preprocessor.json", **entries)
    with refused(entry):
        DiffusionPolicy.from_lerobot(folder)


@pytest.mark.parametrize(
    "name", ["config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json"]
)
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with refused(name, FileNotFoundError):
        DiffusionPolicy.from_lerobot(folder)


def test_shards_and_statistics_of_other_shapes_are_refused(folder):
    statistics = next(folder.glob("policy_preprocessor*.safetensors"))
    kept = load_file(statistics)
    save_file(kept | {"observation.state.max": torch.ones(4)}, statistics)
    with refused("observation.state.max"):
        DiffusionPolicy.from_lerobot(folder)
    save_file(kept | {"action.max": kept["action.max"] + 1}, statistics)
    with refused("action"):
        DiffusionPolicy.from_lerobot(folder)
    save_file(kept, statistics)
    (folder / "model.safetensors").rename(folder / "model-00001-of-00002.safetensors")
    with refused("model.safetensors"):
        DiffusionPolicy.from_lerobot(folder)
