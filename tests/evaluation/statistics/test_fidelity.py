import pytest
import torch

from tests.refusals import refused
from torchrl_sparse.evaluation.statistics import fidelity
from torchrl_sparse.evaluation.statistics.fidelity import action_error, block_errors, relative_error
from torchrl_sparse.networks.diffusion.sampler import Sampler
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

STEPS, LAYERS, SAMPLES = 8, 2, 2


@pytest.fixture(scope="module")
def query():
    torch.manual_seed(0)
    network = TransformerForDiffusion(
        input_dim=4, output_dim=4, horizon=5, n_obs_steps=2, cond_dim=3, n_layer=LAYERS, n_emb=16
    ).eval()
    noise, cond = torch.randn(SAMPLES, STEPS, 5, 4), torch.randn(SAMPLES, 2, 3)
    return network, Sampler("ddpm", STEPS), noise, cond


def test_action_error():
    chunk = torch.zeros(2, 4, 3)
    other = chunk.clone()
    other[1, 2, 0] = -2.4
    assert action_error(other, chunk) == pytest.approx((0.1, 2.4))
    with refused("chunks"):
        action_error(chunk[:, :3], chunk)


def test_relative_error_by_hand():
    dense = torch.zeros(3, 2, 1, 2)
    dense[..., 0] = 2.0
    features = dense.clone()
    features[1, 1, 0] = torch.tensor([2.0, 1.0])
    expected = torch.zeros(2, 3, dtype=torch.float64)
    expected[1, 1] = 0.5
    assert torch.equal(relative_error(features, dense), expected)


def test_nothing_pruned_no_error(query):
    errors = block_errors(*query, {"all": torch.zeros(STEPS, 3 * LAYERS, dtype=torch.bool)})
    assert torch.equal(errors["all"], torch.zeros(STEPS, 3 * LAYERS, dtype=torch.float64))


def test_errors_begin_where_reuse_begins(query):
    mask = torch.zeros(STEPS, 3 * LAYERS, dtype=torch.bool)
    mask[3:6, 2] = True
    errors = block_errors(*query, {"ffn": mask})["ffn"]
    assert errors.shape == (STEPS, 3 * LAYERS)
    assert torch.equal(errors[:3], torch.zeros_like(errors[:3]))
    # In step 3 the blocks before the reused one still see what the dense run saw.
    assert torch.equal(errors[3, :2], torch.zeros_like(errors[3, :2]))
    assert (errors[3, 2:] > 0).all()
    assert (errors[5:] > 0).all()


def test_many_queries_count_alike_and_few_are_held_at_once(query, monkeypatch):
    network, sampler, _, _ = query
    noise, cond = torch.randn(19, STEPS, 5, 4), torch.randn(19, 2, 3)
    mask = torch.zeros(STEPS, 3 * LAYERS, dtype=torch.bool)
    mask[2:5] = True
    alone = [
        block_errors(network, sampler, noise[i : i + 1], cond[i : i + 1], {"a": mask})["a"] for i in range(19)
    ]
    held = []
    monkeypatch.setattr(
        fidelity,
        "relative_error",
        lambda sparse, dense: held.append(dense.shape[2]) or relative_error(sparse, dense),
    )
    together = block_errors(network, sampler, noise, cond, {"a": mask})["a"]
    torch.testing.assert_close(together, sum(alone) / 19, rtol=1e-4, atol=1e-5)
    assert max(held) <= 8
    assert sum(held) == 19
