"""Which engine is made, what it says of itself, and what its blocks cost."""

import copy
import pickle

import pytest
import torch

from tests.blocks.conftest import ACTION_DIM, HORIZON, NUM_STEPS, random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.engine import ENGINES, make_engine
from torchrl_sparse.blocks.engine.costs import engine_block_costs
from torchrl_sparse.blocks.engine.eager import EagerBaseline
from torchrl_sparse.blocks.engine.factory import EngineSlot
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.networks.diffusion.sampler import Sampler


@pytest.fixture
def no_native(monkeypatch):
    entry = ENGINES["native"]._replace(applies=lambda network: (False, "it was not built"))
    monkeypatch.setitem(ENGINES, "native", entry)


def test_auto_takes_torch_where_native_does_not_apply_and_says_why(network, ddpm, no_native):
    assert make_engine("auto", network, ddpm).name == "torch"
    description = EngineSlot("auto").describe(network, ddpm)
    assert description.startswith("torch: cpu")
    assert description.endswith("(not native: it was not built)")
    assert "native" not in EngineSlot("torch").describe(network, ddpm)


def test_unknown_engines_are_refused(network, ddpm):
    entry = "engine"
    with refused(entry):
        make_engine("turbo", network, ddpm)
    with refused(entry):
        EngineSlot("turbo")


def test_native_is_refused_with_the_reason_where_it_does_not_apply(network, ddpm):
    with refused("native engine"):
        make_engine("native", network.double(), ddpm)


def test_a_slot_keeps_its_engine_until_schedule_or_weights_type_change(network, ddpm, no_native):
    slot = EngineSlot("auto")
    engine = slot.get(network, ddpm)
    assert slot.get(network, ddpm) is engine
    assert slot.get(network, copy.copy(ddpm)) is not engine
    engine = slot.get(network, ddpm)
    assert slot.get(network.double(), ddpm) is not engine


def test_a_slot_can_be_copied_and_pickled(network, ddpm):
    slot = EngineSlot("torch")
    slot.get(network, ddpm)
    for again in (copy.deepcopy(slot), pickle.loads(pickle.dumps(slot))):
        assert again.get(network, ddpm).name == "torch"


@pytest.mark.parametrize("name", ["reference", "torch"])
def test_block_costs_are_measured_and_counted(network, ddpm, name):
    costs = engine_block_costs(make_engine(name, network, ddpm))
    assert list(costs) == ["SA", "CA", "FFN"]
    assert all(0 < cost.seconds < 0.1 for cost in costs.values())
    width, memory = 32, 3
    full = 2 * width * width * (HORIZON + memory) + 2 * HORIZON * memory * width
    folded = 2 * HORIZON * memory * network.n_head * width
    assert costs["CA"].flops == 2 * (full if name == "reference" else folded)
    assert costs["FFN"].flops == 2 * 8 * width * width * HORIZON


class TestEagerBaseline:
    """It must do what the reference does, or speed-ups against it would compare different work."""

    def noise(self, seed):
        """The noise that diffusers draws from this generator: the initial sample is ours, the rest its own."""
        generator = torch.Generator().manual_seed(seed)
        steps = [torch.randn(1, HORIZON, ACTION_DIM, generator=generator) for _ in range(NUM_STEPS - 1)]
        initial = torch.randn(1, HORIZON, ACTION_DIM, generator=generator)
        return torch.stack([initial, *steps], dim=1)

    @pytest.mark.parametrize("pruned", [False, True])
    @pytest.mark.parametrize("name", ["ddpm", "ddpm_trailing", "ddim", "ddim_eta0.5", "ddim_trailing"])
    def test_equals_the_reference_on_the_noise_that_diffusers_draws(self, network, name, query, pruned):
        sampler, noise, cond = Sampler.from_name(name, NUM_STEPS), self.noise(7), query[1][:1]
        mask = random_mask(1) if pruned else None
        expected = denoise(network, sampler, noise, cond, mask)
        eager = EagerBaseline(network, sampler)
        generator = torch.Generator().manual_seed(7)
        actions = eager.denoise(noise[:, 0], cond, mask if mask is None else mask[0], generator=generator)
        torch.testing.assert_close(actions, expected, atol=1e-4, rtol=0)

    def test_timesteps_that_diffusers_does_not_have_are_refused(self, network):
        for sampler in (
            Sampler("ddim", timesteps=[90, 50]),
            Sampler("ddim", 3, spacing="trailing"),
            Sampler("unipc", 5),
        ):
            with pytest.raises(ValueError, match=f"diffusers has no sampler {sampler.name!r}"):
                EagerBaseline(network, sampler)
