"""A policy on disk keeps its sampler and its planner; older folders, which name no planner, are dense."""

import json

import pytest
import torch

from tests.policies.diffusion.test_policy import request
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Planner, SAGPruner, Sampler, StaticPlanner, keys
from torchrl_sparse.blocks.planner import Dense
from torchrl_sparse.blocks.sag import PrunerInfo, PrunerNetwork
from torchrl_sparse.blocks.uniform import Uniform


class LateAlone(StaticPlanner):
    """Of no format of its own, and with another rule of reuse."""

    reuse = "type"

    def mask(self, spec):
        return (torch.arange(spec.num_inference_steps) >= 2)[:, None].repeat(1, spec.num_blocks)


class WhenFar(Planner):
    """Looks at the observation and has no format."""

    def masks(self, cond):
        return torch.zeros(len(cond), self.spec.num_inference_steps, self.spec.num_blocks, dtype=torch.bool)


def learned(policy):
    info = PrunerInfo(policy.fingerprint, policy.sampler.name, 0.7, (0.3, 0.8))
    blocks, cond = policy.num_blocks, (policy.n_obs_steps, policy.network.cond_dim)
    pruner = SAGPruner(PrunerNetwork(policy.sampler.timesteps.tolist(), blocks, cond, rate_input=True), info)
    pruner.rate = 0.4
    return pruner


@pytest.fixture
def stored(policy, tmp_path):
    """A policy whose weights are those of a file, so that fp16 changes them no more."""
    policy.save_pretrained(tmp_path / "first")
    return DiffusionPolicy.from_pretrained(tmp_path / "first")


@pytest.mark.parametrize("make", [lambda _: Uniform(3, last=True), lambda _: LateAlone(), learned])
def test_sampler_and_planner_are_kept(stored, tmp_path, make):
    stored.sampler = Sampler("ddim", timesteps=[90, 50, 20, 10])
    stored.plan = make(stored)
    stored.save_pretrained(tmp_path / "fast")
    loaded = DiffusionPolicy.from_pretrained(tmp_path / "fast")
    assert loaded.sampler.name == "ddim_90_50_20_10"
    ours, theirs = stored(request(3)), loaded(request(3))
    assert ours[keys.PRUNE_MASK].any()
    assert stored.plan.reuse == loaded.plan.reuse
    for key in (keys.PRUNE_MASK, keys.CHUNK):
        assert torch.equal(ours[key], theirs[key])
    loaded.save_pretrained(tmp_path / "again")
    assert DiffusionPolicy.from_pretrained(tmp_path / "again").plan.fingerprint == loaded.plan.fingerprint


def test_a_dense_policy_saved_over_a_fast_one_is_dense(stored, tmp_path):
    stored.plan = Uniform(2)
    stored.save_pretrained(tmp_path)
    stored.plan = None
    stored.save_pretrained(tmp_path)
    assert isinstance(DiffusionPolicy.from_pretrained(tmp_path).plan, Dense)


def test_a_planner_without_a_format_is_refused_before_anything_is_written(stored, tmp_path):
    stored.plan = WhenFar()
    with refused("plan"):
        stored.save_pretrained(tmp_path / "fast")
    assert not (tmp_path / "fast").exists()


@pytest.fixture
def fast(stored, tmp_path):
    stored.plan = Uniform(2)
    stored.save_pretrained(tmp_path / "fast")
    return tmp_path / "fast"


def change(file, **entries):
    file.write_text(json.dumps(json.loads(file.read_text()) | entries))


def test_a_planner_of_another_policy_is_refused_by_name(fast):
    change(fast / "plan.json", policy="another")
    with refused("plan.json"):
        DiffusionPolicy.from_pretrained(fast)


def test_a_planner_elsewhere_is_refused(fast):
    change(fast / "config.json", plan="../plan.json")
    with refused("config.json: plan"):
        DiffusionPolicy.from_pretrained(fast)


def test_a_missing_planner_is_named(fast):
    (fast / "plan.json").unlink()
    with refused("plan.json", FileNotFoundError):
        DiffusionPolicy.from_pretrained(fast)
