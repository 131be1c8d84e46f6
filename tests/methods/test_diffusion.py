"""Methods by name: what is made of each, how rates are written, and what one from another package takes."""

import re

import pytest
import torch
from tensordict import TensorDict

from tests.fixtures.diffusion import SIZES
from tests.refusals import refused
from torchrl_sparse import DiffusionPolicy, Normalizer, Sampler, keys
from torchrl_sparse.blocks.bac import bac_schedule
from torchrl_sparse.blocks.calibration import calibrate
from torchrl_sparse.blocks.engine import native_available
from torchrl_sparse.blocks.planner import Dense, StaticPlanner
from torchrl_sparse.blocks.sag import PrunerInfo, PrunerNetwork, SAGPruner
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.blocks.uniform import Uniform
from torchrl_sparse.control.action_aware import ActionAwareController
from torchrl_sparse.methods.diffusion import (
    METHODS,
    Method,
    check_method,
    make_controller,
    make_method,
    method_identity,
)
from torchrl_sparse.methods.executor import make_executor
from torchrl_sparse.methods.spec import MethodSpec

LAYERS = 2
QUERY = TensorDict({"history": {"state": torch.zeros(1, 2, SIZES["cond_dim"])}}, [1])


@pytest.fixture
def policy(make_network):
    normalizer = Normalizer(torch.ones(5), torch.zeros(5), torch.ones(10), torch.zeros(10))
    return DiffusionPolicy(make_network(n_layer=LAYERS), normalizer, sampler=Sampler("ddpm", 20))


@pytest.fixture
def make(policy, tmp_path):
    """Makes a method of `policy`, by default with planners in `tmp_path` and nothing to calibrate."""

    def make(text, calibration=pytest.fail):
        return make_method(text, policy, num_updates=5, planners=tmp_path, calibration=calibration)

    return make


@pytest.fixture
def pruner(policy, tmp_path):
    """A pruner for DDIM with four steps that takes a rate, saved as `sag`."""
    torch.manual_seed(0)
    network = PrunerNetwork([75, 50, 25, 0], 3 * LAYERS, (2, SIZES["cond_dim"]), rate_input=True)
    pruner = SAGPruner(network, PrunerInfo(policy.fingerprint, "ddim", 0.5, (0.3, 0.7)))
    pruner.save_pretrained(tmp_path / "sag")
    return pruner


class Odd(StaticPlanner):
    """Skips every second step; a planner of another package."""

    def mask(self, spec):
        odd = torch.arange(spec.num_inference_steps) % 2 == 1
        return odd[:, None].repeat(1, spec.num_blocks)


def test_one_line_adds_a_method_from_outside(policy, make, tmp_path, monkeypatch):
    with refused("methods"):
        make("odd")
    monkeypatch.setitem(METHODS, "odd", Method(lambda inputs: (Odd(), inputs.sampler)))
    mask = make("odd")(QUERY.clone())[keys.PRUNE_MASK]
    assert mask[0].any(dim=1).tolist() == 10 * [False, True]
    with refused("methods"):
        check_method("even", tmp_path)


def test_a_warm_start_is_written_behind_its_sampler(make):
    warm = make("ddpm_82_41_14_warm2")
    assert (warm.sampler.name, warm.start.name) == ("ddpm_82_41_14", "warm2")
    assert method_identity("ddpm_82_41_14_warm2", warm)["start"] == "warm2"
    assert warm.with_noise(1).start is warm.start
    assert "start" not in method_identity("ddpm_82_41_14", make("ddpm_82_41_14"))
    with refused("num_steps"):
        make("ddim2_warm2")


def test_how_often_and_for_how_many_chunks_is_written_behind_any_method(make):
    for text, every, samples in (
        ("ddpm_82_14_every2_of8", 2, 8),
        ("uniform2_every1", 1, 1),
        ("dense_of4", 8, 4),
    ):
        actor = make_executor(text, make(text), n_action_steps=8)
        assert (actor.n_action_steps, actor.num_samples) == (every, samples)
        assert (actor.selector is not None) == (samples > 1)
    assert make("ddpm_82_14_every2_of8").sampler.name == "ddpm_82_14"
    assert MethodSpec.parse("sag_every2:int8@0.9") == MethodSpec("sag", rates=(0.9,), weights="int8", every=2)


def test_a_chunk_is_not_executed_beyond_its_end(make):
    with refused("methods: dense_every9"):
        make_executor("dense_every9", make("dense_every9"), n_action_steps=2)


def test_a_method_may_bring_its_own_controller(monkeypatch):
    controller = ActionAwareController(coarse=1, fine=2)
    mine = Method(lambda inputs: (Odd(), inputs.sampler), controller=lambda rates: controller)
    monkeypatch.setitem(METHODS, "odd", mine)
    assert make_controller("odd") is controller


def test_dense_shares_the_networks(policy, make):
    dense = make("dense")
    assert dense.network is policy.network
    assert dense.sampler is policy.sampler
    assert isinstance(dense.plan, Dense)


def test_dense_with_other_noise_is_dense_but_for_its_noise(make):
    query = (
        QUERY.clone().set(keys.EPISODE_SEED, torch.tensor([[7]])).set(keys.EPISODE_STEP, torch.tensor([[8]]))
    )
    dense, other = make("dense"), make("dense_noise")
    answers = [method(query.clone()) for method in (dense, other, other)]
    assert answers[0][keys.SEED] != answers[1][keys.SEED]
    assert (answers[0][keys.CHUNK] != answers[1][keys.CHUNK]).any()
    assert (answers[1][keys.CHUNK] == answers[2][keys.CHUNK]).all()
    assert (answers[0][keys.COND] == answers[1][keys.COND]).all()
    identities = [method_identity("dense", method) for method in (dense, other)]
    assert identities[1] == {**identities[0], "noise": 1}
    assert other.with_plan(Dense()).noise_stream == 1


@pytest.mark.parametrize(
    ("name", "timesteps"),
    [
        ("ddim10", list(range(90, -1, -10))),
        ("ddim4", [75, 50, 25, 0]),
        ("ddim_87_20", [87, 20]),
        ("ddpm_82_14", [82, 14]),
        ("ddpm2_logsnr", [91, 41]),
        ("ddim4_trailing_eta0.5", [99, 74, 49, 24]),
        ("unipc_90_50_3", [90, 50, 3]),
    ],
)
def test_samplers_are_taken_from_the_name(make, name, timesteps):
    method = make(name)
    assert method.sampler.kind == re.match("ddim|ddpm|unipc", name)[0]
    assert method.sampler.timesteps.tolist() == timesteps
    assert isinstance(method.plan, Dense)
    assert method(QUERY.clone())[keys.CHUNK].isfinite().all()
    assert make_controller(name) is None


@pytest.mark.parametrize(
    "name",
    [
        "ddim0",
        "ddim_",
        "ddpm",
        "ddim10_eta",
        "Dense",
        "bac@0.5-",
        "dense@1",
        "dense:fp4",
        "dense@0.5:bf16",
        "uniform@0.5@0.5",
        "uniform0",
        "uniform7_",
        "",
    ],
)
def test_other_names_are_refused(make, name):
    with refused("methods"):
        make(name)


def test_uniform_computes_each_block_as_often_as_asked(make):
    planner = make("uniform").plan
    assert isinstance(planner, Uniform)
    assert (~planner.mask(planner.spec)).sum(dim=0).tolist() == [5] * 3 * LAYERS


@pytest.mark.parametrize(
    ("name", "kind", "computed"),
    [("uniform7", "ddpm", [0, 7, 14, 19]), ("uniform2_ddim4", "ddim", [0, 2, 3]), ("uniform2_ddpm_82_40_14", "ddpm", [0, 2])],
)  # fmt: skip
def test_uniform_with_an_interval_also_computes_the_last_step(make, name, kind, computed):
    method = make(name)
    mask = method(QUERY.clone())[keys.PRUNE_MASK][0]
    assert method.sampler.kind == kind
    assert (~mask).all(dim=1).nonzero().flatten().tolist() == computed
    assert mask.any(dim=1).sum() == len(mask) - len(computed)


def test_bac_is_read_where_it_fits_and_computed_where_not(policy, make, tmp_path):
    noise, cond = policy.sample_noise(torch.tensor([1])), torch.zeros(1, 2, SIZES["cond_dim"])
    computed = make("bac", lambda: calibrate(policy.network, policy.sampler, noise, cond)).plan.schedule
    assert computed.settings["num_updates"] == 5
    computed.save_pretrained(tmp_path / "bac.json")
    assert make("bac").plan.schedule == computed  # without a calibration
    asked = []
    with pytest.raises(AttributeError):
        make_method(
            "bac", policy, num_updates=6, planners=tmp_path, calibration=lambda: asked.append("asked")
        )
    assert asked == ["asked"]


@pytest.mark.parametrize("chain", ["ddim10", "ddpm_82_40_14", "sde2m6_logsnr"])
def test_bac_of_another_sampler_is_a_saved_planner(policy, make, tmp_path, chain):
    """What `calibrate_bac sampler=CHAIN` writes."""
    sampler = Sampler.from_name(chain)
    noise = torch.randn(1, sampler.num_inference_steps, SIZES["horizon"], 10)
    calibration = calibrate(policy.network, sampler, noise, torch.zeros(1, 2, SIZES["cond_dim"]))
    schedule = bac_schedule(calibration, 2, policy=policy.fingerprint)
    schedule.save_pretrained(tmp_path / f"bac_{chain}.json")
    method = make(f"bac_{chain}")
    assert method.sampler.config == sampler.config
    assert torch.equal(method(QUERY.clone())[keys.PRUNE_MASK][0], schedule.mask())
    with refused("SchedulePlanner"):
        policy.with_plan(SchedulePlanner(schedule))


def test_a_saved_planner_brings_its_sampler(policy, make, tmp_path):
    mask = torch.tensor([[False], [True], [True]]).repeat(1, 3 * LAYERS)
    schedule = CacheSchedule.from_mask(
        mask, method="mine", policy=policy.fingerprint, sampler="ddim_90_50_10"
    )
    schedule.save_pretrained(tmp_path / "mine.json")
    method = make("mine")
    assert method.sampler.timesteps.tolist() == [90, 50, 10]
    assert torch.equal(method(QUERY.clone())[keys.PRUNE_MASK][0], mask)


@pytest.mark.usefixtures("pruner")
@pytest.mark.skipif(not native_available()[0], reason=native_available()[1])
@pytest.mark.parametrize("weights", ["bf16", "int8"])
def test_rounded_weights_are_written_behind_the_name(make, weights):
    exact, rounded = make("dense"), make(f"dense:{weights}")
    assert rounded.network is exact.network
    assert exact.engine == "auto"
    seeded = QUERY.clone().update(
        {"episode": {"seed": torch.ones(1, 1).long(), "step": torch.ones(1, 1).long()}}
    )
    error = (rounded(seeded.clone())[keys.CHUNK] - exact(seeded.clone())[keys.CHUNK]).abs().max()
    assert 1e-5 < error < 0.1
    assert method_identity(f"dense:{weights}", rounded)["engine"] == f"native_{weights}"
    assert make(f"dense_noise:{weights}").noise_stream == make("dense_noise").noise_stream
    assert make(f"sag:{weights}@0.3").plan.rate == 0.3
    assert make_controller(f"sag:{weights}@0.7-0.4").budgets == (0.7, 0.4)


@pytest.mark.usefixtures("pruner")
def test_rates_are_written_behind_the_name(make):
    assert make("sag").plan.rate == 0.5
    assert make_controller("sag") is make_controller("sag@0.6") is None
    assert make("sag@0.6").plan.rate == 0.6
    coarse_then_fine = make("sag@0.7-0.4")
    assert coarse_then_fine.plan.rate == 0.7
    assert coarse_then_fine.num_inference_steps == 4
    controller = make_controller("sag@0.7-0.4")
    assert controller.budgets == (0.7, 0.4)
    assert keys.PRUNE_RATE in controller.out_keys


@pytest.mark.usefixtures("pruner")
@pytest.mark.parametrize("text", ["sag@0.9", "sag@0.7-0.1", "sag@0.9-0.5"])
def test_a_rate_out_of_range_is_refused_at_once(make, text):
    with refused("rate"):
        make(text)


def test_planners_without_a_rate_say_so(make):
    with refused("methods: uniform"):
        make("uniform@0.5")
