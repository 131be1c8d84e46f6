"""Policy calls that are guided toward actions: every engine against the sampler's equations written out."""

import pytest
import torch

from tests.blocks.engine.native.test_engine import make_network, make_query
from tests.refusals import refused
from torchrl_sparse.blocks.engine import denoise
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.reference import ReferenceEngine
from torchrl_sparse.blocks.engine.torch import TorchEngine
from torchrl_sparse.networks.diffusion.coefficients import Guide
from torchrl_sparse.networks.diffusion.sampler import Sampler

AVAILABLE, SETS = native_available()
ENGINES = {"reference": ReferenceEngine, "torch": TorchEngine}
for name in SETS.split(", ") if AVAILABLE else []:
    ENGINES[name] = lambda network, sampler, level=name: NativeEngine(network, sampler, instruction_set=level)
SAMPLERS = ["ddpm6", "ddpm_82_14", "ddim5", "ddim5_eta0.5", "sde2m5", "unipc5"]


def make_guide(network, batch, seed=1):
    generator = torch.Generator().manual_seed(seed)
    actions = 2 * torch.rand(batch, network.horizon, network.input_dim, generator=generator) - 1
    pull = torch.rand(batch, network.horizon, 1, generator=generator)
    pull[:, :2] = torch.tensor([1.0, 0.0])[:, None]
    return Guide(actions, pull)


def written_out(network, sampler, noise, cond, guide):
    """Nothing pruned, in double precision, with the clean prediction of every step taken apart."""
    table, sample, cleans = sampler.coefficients, noise[:, 0], []
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        eps = network(sample, timestep, cond)
        clean = ((sample - table.noise_scale[k] * eps) / table.signal_scale[k]).clamp(-1, 1)
        clean = (1 - guide.pull) * clean + guide.pull * guide.actions
        after = table.clean_weight[k] * clean + table.sample_weight[k] * sample + table.eps_weight[k] * eps
        for weight, before in zip((table.previous_weight[k], table.earlier_weight[k]), cleans, strict=False):
            after = after + weight * before
        if table.spread[k]:
            after = after + table.spread[k] * noise[:, k + 1]
        sample, cleans = after, [clean, *cleans][:2]
    return sample.float()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("chain", SAMPLERS)
def test_every_engine_draws_as_written_out(engine, chain):
    network, sampler = make_network("block push"), Sampler.from_name(chain)
    noise, cond, _ = make_query(network, sampler, batch=3)
    guide = make_guide(network, 3)
    network.double()
    expected = written_out(
        network, sampler, noise.double(), cond.double(), Guide(*(part.double() for part in guide))
    )
    network.float()
    actual = ENGINES[engine](network, sampler).denoise(noise, cond, guide=guide)
    assert (actual - expected).abs().max() < 1e-5
    torch.testing.assert_close(actual[:, 0], guide.actions[:, 0], rtol=0, atol=1e-6)  # drawn all the way


@pytest.mark.parametrize("engine", ENGINES)
def test_pruned_queries_too_and_a_row_as_if_alone(engine):
    network, sampler = make_network("lift"), Sampler("ddpm", 6)
    noise, cond, mask = make_query(network, sampler, batch=4)
    guide = make_guide(network, 4)
    made = ENGINES[engine](network, sampler)
    for reuse in ("block", "type", "single"):
        together = made.denoise(noise, cond, mask, reuse, guide)
        expected = denoise(network, sampler, noise, cond, mask, reuse=reuse, guide=guide)
        assert (together - expected).abs().max() < 1e-5
        for row in range(4):
            one = slice(row, row + 1)
            alone = made.denoise(noise[one], cond[one], mask[one], reuse, guide.rows(torch.tensor([row])))
            assert (alone[0] - together[row]).abs().max() < 1e-5


@pytest.mark.parametrize("engine", ENGINES)
def test_no_pull_changes_nothing_and_is_forgotten(engine):
    network, sampler = make_network("lift"), Sampler("ddpm", 6)
    noise, cond, mask = make_query(network, sampler)
    made = ENGINES[engine](network, sampler)
    free = made.denoise(noise, cond, mask)
    guide = make_guide(network, 2)
    nothing = Guide(guide.actions, torch.zeros_like(guide.pull))
    torch.testing.assert_close(made.denoise(noise, cond, mask, guide=nothing), free, rtol=0, atol=1e-6)
    assert not torch.equal(made.denoise(noise, cond, mask, guide=guide), free)
    assert torch.equal(made.denoise(noise, cond, mask), free)


@pytest.mark.skipif(not AVAILABLE, reason=SETS)
def test_threads_change_no_bit():
    network, sampler = make_network("lift"), Sampler("ddpm", 6)
    for batch in (1, 3):
        noise, cond, mask = make_query(network, sampler, batch=batch)
        guide = make_guide(network, batch)
        one, two = (
            NativeEngine(network, sampler, threads=n).denoise(noise, cond, mask, guide=guide) for n in (1, 2)
        )
        assert torch.equal(one, two)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("change", "entry"),
    [
        (lambda guide: guide._replace(actions=guide.actions[:, :3]), "guide.actions"),
        (lambda guide: guide._replace(pull=guide.pull[..., 0]), "guide.pull"),
        (lambda guide: guide._replace(pull=guide.pull.double()), "guide.pull"),
        (lambda guide: guide._replace(pull=guide.pull + 1), "guide.pull"),
        (lambda guide: guide._replace(pull=guide.pull * torch.nan), "guide.pull"),
    ],
)  # fmt: skip
def test_a_wrong_guide_is_refused_by_name(engine, change, entry):
    network, sampler = make_network("lift"), Sampler("ddpm", 6)
    noise, cond, _ = make_query(network, sampler)
    with refused(entry):
        ENGINES[engine](network, sampler).denoise(noise, cond, guide=change(make_guide(network, 2)))
