import json
import re

import pytest
import torch
from tensordict import TensorDict

from tests.blocks.conftest import NUM_LAYERS, NUM_STEPS, random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.keys import COND, PRUNE_MASK


@pytest.fixture
def schedule():
    return CacheSchedule.from_mask(
        random_mask(),
        method="bac",
        policy="8d1f",
        settings={"num_updates": 3, "upstream_blocks": ["layers.1.SA"]},
    )


@pytest.fixture
def path(schedule, tmp_path):
    schedule.save_pretrained(tmp_path / "schedule.json")
    return tmp_path / "schedule.json"


def test_a_file_brings_back_the_same_schedule(schedule, path):
    loaded = CacheSchedule.from_pretrained(path)
    assert loaded == schedule
    assert torch.equal(loaded.mask(), random_mask())


def test_a_file_is_small_plain_json_with_one_line_per_block(path):
    text = path.read_text()
    assert json.loads(text)["computed_steps"].keys() == {
        f"layers.{i}.{b}" for i in (0, 1) for b in ("SA", "CA", "FFN")
    }
    assert len(text.splitlines()) == 8 + 6 + 4
    assert re.search(r'^    "layers\.1\.CA": \[0, [\d, ]+\],$', text, re.MULTILINE)


def test_blocks_may_be_listed_in_any_order(schedule, path):
    data = json.loads(path.read_text())
    data["computed_steps"] = dict(reversed(data["computed_steps"].items()))
    path.write_text(json.dumps(data))
    assert CacheSchedule.from_pretrained(path) == schedule


def test_saving_replaces_a_file_whole_and_leaves_nothing_else(schedule, path):
    CacheSchedule.from_mask(torch.zeros(4, 3, dtype=torch.bool), method="dense", policy="x").save_pretrained(
        path
    )
    assert CacheSchedule.from_pretrained(path).num_inference_steps == 4
    unwritable = CacheSchedule.from_mask(
        schedule.mask(), method="bac", policy="8d1f", settings={"bad": object()}
    )
    with pytest.raises(TypeError):
        unwritable.save_pretrained(path)
    assert CacheSchedule.from_pretrained(path).num_inference_steps == 4
    assert [file.name for file in path.parent.iterdir()] == ["schedule.json"]


@pytest.mark.parametrize(
    ("damage", "entry"),
    [
        (lambda text: text[: len(text) // 2], "schedule.json"),
        (lambda text: "", "schedule.json"),
        (lambda text: "[1, 2]", "schedule.json"),
        (lambda text: text.replace("schedule/1", "schedule/9"), "schedule.json: format"),
        (lambda text: "{}", "schedule.json: format"),
        (lambda text: text.replace('"method": "bac",', ""), "schedule.json: method"),
        (
            lambda text: text.replace('"settings"', '"seting"'),
            "schedule.json: settings",
        ),
        (
            lambda text: text.replace('"policy": "8d1f"', '"policy": 7'),
            "schedule.json: policy",
        ),
        (lambda text: text.replace('_steps": 10', '_steps": 10.0'), "schedule.json: num_inference_steps"),
        (lambda text: text.replace('_layers": 2', '_layers": "2"'), "schedule.json: num_layers"),
        (
            lambda text: text.replace('_layers": 2', '_layers": 3'),
            "schedule.json: computed_steps",
        ),
        (lambda text: text.replace("layers.1.CA", "layers.1.XX"), "schedule.json: computed_steps"),
        (
            lambda text: text.replace('.CA": [0, ', '.CA": [', 1),
            "schedule.json: computed_steps of layers.0.CA",
        ),
        (
            lambda text: text.replace('.FFN": [0, ', '.FFN": [0, 0, ', 1),
            "schedule.json: computed_steps of layers.0.FFN",
        ),
        (
            lambda text: text.replace('.SA": [0, ', '.SA": [0, 10, ', 1),
            "schedule.json: computed_steps of layers.0.SA",
        ),
        (
            lambda text: text.replace('.SA": [0, ', '.SA": [0, "1", ', 1),
            "schedule.json: computed_steps.layers.0.SA.1",
        ),
        (
            lambda text: re.sub(r'SA": \[.*\]', 'SA": null', text, count=1),
            "schedule.json: computed_steps.layers.0.SA",
        ),
        (
            lambda text: re.sub(r'SA": \[.*\]', 'SA": []', text, count=1),
            "schedule.json: computed_steps of layers.0.SA",
        ),
    ],
)
def test_a_damaged_file_is_refused_naming_file_and_field(path, damage, entry):
    before = path.read_text()
    path.write_text(damage(before))
    assert path.read_text() != before
    with refused(entry):
        CacheSchedule.from_pretrained(path)


def test_binary_rubbish_and_a_missing_file_are_refused(tmp_path):
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    with refused("binary"):
        CacheSchedule.from_pretrained(tmp_path / "binary")
    with refused("nowhere.json", FileNotFoundError):
        SchedulePlanner.from_pretrained(tmp_path / "nowhere.json")


@pytest.mark.parametrize(
    "mask", [torch.zeros(4, 5, dtype=torch.bool), torch.ones(4, 6, dtype=torch.bool), torch.zeros(4, 6)]
)
def test_only_prune_masks_become_schedules(mask):
    with refused("prune mask"):
        CacheSchedule.from_mask(mask, method="by hand", policy="x")


@pytest.mark.parametrize("from_file", [True, False])
def test_the_planner_writes_the_schedule_for_every_observation(schedule, path, from_file):
    planner = SchedulePlanner.from_pretrained(path) if from_file else SchedulePlanner(schedule)
    planner.bind(PlanSpec(NUM_STEPS, NUM_LAYERS, "8d1f"))
    masks = planner(TensorDict({COND: torch.randn(3, 2, 5)}, [3]))[PRUNE_MASK]
    assert torch.equal(masks, random_mask().expand(3, -1, -1))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (PlanSpec(NUM_STEPS, NUM_LAYERS, "77aa"), "policy fingerprint '8d1f', got '77aa'"),
        (PlanSpec(100, NUM_LAYERS, "8d1f"), "num_inference_steps 10, got 100"),
        (PlanSpec(NUM_STEPS, 8, "8d1f"), "num_layers 2, got 8"),
        (PlanSpec(NUM_STEPS, NUM_LAYERS, "8d1f", "ddim"), "sampler 'ddpm', got 'ddim'"),
        (PlanSpec(NUM_STEPS, NUM_LAYERS, "8d1f", "ddim_9_5"), "sampler 'ddpm', got 'ddim_9_5'"),
    ],
)
def test_a_schedule_made_for_another_policy_is_refused_naming_both(schedule, spec, message):
    with refused("SchedulePlanner"):
        SchedulePlanner(schedule).bind(spec)
