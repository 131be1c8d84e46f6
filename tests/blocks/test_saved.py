"""Planners' files say what they are: one function reads them all, those of other packages too."""

import json

import pytest
import torch

from tests.refusals import refused
from torchrl_sparse import SAGPruner, StaticPlanner, load_planner
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.sag import PrunerInfo, PrunerNetwork
from torchrl_sparse.blocks.saved import PLANNERS, saved_planners
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner


class Until(StaticPlanner):
    """Computes everything until a step and nothing afterwards, and is kept in a file."""

    def __init__(self, step):
        super().__init__()
        self.step = step

    def mask(self, spec):
        late = torch.arange(spec.num_inference_steps) > self.step
        return late[:, None].repeat(1, spec.num_blocks)

    @classmethod
    def from_pretrained(cls, path):
        return cls(json.loads(path.read_text())["step"])


def test_the_format_chooses_the_class(tmp_path):
    mask = torch.tensor([[False] * 3, [True] * 3])
    planner = SchedulePlanner(CacheSchedule.from_mask(mask, method="by hand", policy="8d1f"))
    planner.save_pretrained(tmp_path / "schedule.json")
    read = load_planner(tmp_path / "schedule.json")
    assert isinstance(read, SchedulePlanner)
    assert read.schedule == planner.schedule

    pruner = SAGPruner(PrunerNetwork([1, 0], 3, (2, 5)), PrunerInfo("8d1f", "ddim", 0.7))
    pruner.save_pretrained(tmp_path / "sag")
    read = load_planner(tmp_path / "sag")
    assert isinstance(read, SAGPruner)
    assert read.fingerprint == pruner.fingerprint
    assert read.made_for == PlanSpec(2, 1, "8d1f", "ddim")


def test_a_class_of_another_package_takes_one_line(tmp_path, monkeypatch):
    (tmp_path / "until.json").write_text('{"format": "elsewhere.until/1", "step": 2}')
    with refused("until.json: format"):
        load_planner(tmp_path / "until.json")
    monkeypatch.setitem(PLANNERS, "elsewhere.until/1", Until)
    planner = load_planner(tmp_path / "until.json")
    planner.bind(PlanSpec(4, 1, "any"))
    assert planner.masks(torch.zeros(1, 2, 5))[0, :, 0].tolist() == [False, False, False, True]


@pytest.mark.parametrize("format", ["torchrl_sparse.recall/1", "torchrl_sparse.tts/1"])
def test_a_planner_that_reused_features_of_earlier_calls_is_refused_by_name(tmp_path, format):
    folder = tmp_path / "tts"
    folder.mkdir()
    for path in (tmp_path / "recalling.json", folder / "config.json"):
        path.write_text(json.dumps({"format": format}))
    for path, file in ((tmp_path / "recalling.json", "recalling.json"), (folder, "config.json")):
        message = rf"{file}: format: '{format}' reuses features of earlier policy calls, which this version cannot run"
        with pytest.raises(ValueError, match=message):
            load_planner(path)
    assert saved_planners(tmp_path) == []


@pytest.mark.parametrize("content", ["{}", '{"format": null}', '{"format": ["a"]}'])
def test_a_file_without_a_format_is_named(tmp_path, content):
    (tmp_path / "odd.json").write_text(content)
    with refused("odd.json: format"):
        load_planner(tmp_path / "odd.json")


def test_a_missing_file_is_named(tmp_path):
    with refused("nowhere", FileNotFoundError):
        load_planner(tmp_path / "nowhere")
