import pytest
import torch

from tests.blocks.conftest import ACTION_DIM, COND_DIM, HORIZON, NUM_LAYERS, NUM_STEPS, OBS_STEPS, random_mask
from tests.refusals import refused
from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.blocks.mask import mask_from_steps, num_buffers
from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion

NUM_BLOCKS = 3 * NUM_LAYERS


def dense_loop(network, sampler, noise, cond):
    sample, cleans = noise[:, 0], ()
    for k, timestep in enumerate(sampler.timesteps.tolist()):
        noise_k = noise[:, k + 1] if k + 1 < NUM_STEPS else None
        eps, before = network(sample, timestep, cond), sample
        sample = sampler.step(eps, k, before, noise_k, cleans)
        cleans = sampler.remember(cleans, eps, k, before)
    return sample


class TracingNetwork:
    """Stands in for the network: block b of step k outputs the number 100 k + b, which shows every reuse."""

    n_layer, num_blocks, block_types = NUM_LAYERS, NUM_BLOCKS, ("SA", "CA", "FFN")
    horizon, input_dim, n_obs_steps, cond_dim = HORIZON, ACTION_DIM, OBS_STEPS, COND_DIM
    like = torch.zeros(1)

    def __init__(self):
        self.step = -1

    def embed(self, sample):
        self.step += 1
        return sample

    def memory(self, timestep, cond):
        return cond

    def block(self, index, x, memory):
        return torch.full_like(x, 100 * self.step + index)

    def head_out(self, x):
        return torch.zeros_like(x)


def trace(sampler, masks, reuse):
    """What each block added, [B, K, 3L]."""
    recorder = FeatureRecorder()
    noise = torch.zeros(len(masks), NUM_STEPS, HORIZON, ACTION_DIM)
    cond = torch.zeros(len(masks), OBS_STEPS, COND_DIM)
    denoise(TracingNetwork(), sampler, noise, cond, masks, reuse=reuse, record=recorder)
    return recorder.features()[..., 0, 0].permute(2, 1, 0)


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_no_mask_and_an_all_false_mask_are_bit_exactly_dense(network, sampler, query, reuse):
    expected = dense_loop(network, sampler, *query)
    mask = torch.zeros(5, NUM_STEPS, NUM_BLOCKS, dtype=torch.bool)
    assert torch.equal(denoise(network, sampler, *query), expected)
    assert torch.equal(denoise(network, sampler, *query, mask, reuse=reuse), expected)


def test_pruning_changes_the_result(network, sampler, query):
    difference = denoise(network, sampler, *query, random_mask(5)) - denoise(network, sampler, *query)
    assert (difference.abs().amax(dim=(1, 2)) > 1e-3).all()


def assert_rows_equal_rows_alone(network, sampler, noise, cond, reuse, tolerance):
    masks = random_mask(5, rate=0.6)
    masks[1] = False
    masks[2, 1:] = True
    together = denoise(network, sampler, noise, cond, masks, reuse=reuse)
    for row in range(5):
        part = slice(row, row + 1)
        alone = denoise(network, sampler, noise[part], cond[part], masks[part], reuse=reuse)
        torch.testing.assert_close(together[part], alone, rtol=0, atol=tolerance)


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_a_row_with_its_own_mask_equals_the_row_alone(network, sampler, query, reuse):
    # Matrix products round by batch size, dense or not; the published initialisation does not amplify that.
    torch.manual_seed(0)
    initial = TransformerForDiffusion(**network.config).eval().requires_grad_(False)
    assert_rows_equal_rows_alone(initial, sampler, *query, reuse, tolerance=1e-6)


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_float64_shows_that_a_row_differs_from_the_row_alone_by_rounding_only(network, sampler, query, reuse):
    noise, cond = (tensor.double() for tensor in query)
    assert_rows_equal_rows_alone(network.double(), sampler, noise, cond, reuse, tolerance=1e-13)


def test_type_reuse_follows_a_hand_computed_zigzag(ddpm):
    everywhere = list(range(NUM_STEPS))
    # SA: layer 0 computes in steps 0 and 2, layer 1 in steps 0 and 1.
    steps = [[0, 2], everywhere, everywhere, [0, 1], everywhere, everywhere]
    by_type = trace(ddpm, mask_from_steps(steps, NUM_STEPS)[None], "type")[0]
    assert by_type[:4, 0].tolist() == [0, 3, 200, 200]
    assert by_type[:4, 3].tolist() == [3, 103, 200, 200]
    by_block = trace(ddpm, mask_from_steps(steps, NUM_STEPS)[None], "block")[0]
    assert by_block[:4, 0].tolist() == [0, 0, 200, 200]
    assert by_block[:4, 3].tolist() == [3, 103, 103, 103]
    # In step 3 layer 0's SA reads what layer 1's FFN wrote last, layer 1's SA what layer 0's FFN just wrote.
    single = trace(ddpm, mask_from_steps(steps, NUM_STEPS)[None], "single")[0]
    assert single[:4, 0].tolist() == [0, 5, 200, 205]
    assert single[:4, 3].tolist() == [3, 103, 202, 302]


def reuse_source(mask, reuse):
    """Which evaluation made what a block adds, its own or an earlier one if it is pruned: (step, column), [B, K, 3L]."""
    *batch, num_steps, num_blocks = mask.shape
    # With evaluations numbered in order of execution, the newest computed one is a running maximum.
    order = torch.arange(num_steps * num_blocks).view(num_steps, num_blocks)
    written = order.expand(mask.shape).masked_fill(mask, -1)
    written = written.reshape(*batch, -1, num_buffers(reuse, num_blocks))
    newest = written.cummax(dim=-2).values.reshape(mask.shape)
    return newest // num_blocks, newest % num_blocks


def test_block_reuse_reads_the_most_recent_update_of_the_block():
    mask = mask_from_steps([[0, 3], [0], [0, 1, 2, 3, 4]], num_steps=5)
    step, column = reuse_source(mask, "block")
    assert step.T.tolist() == [[0, 0, 0, 3, 3], [0, 0, 0, 0, 0], [0, 1, 2, 3, 4]]
    assert torch.equal(column, torch.arange(3).expand(5, 3))


def test_type_reuse_zigzags_through_layers():
    # Two layers; SA is computed by layer 0 in steps 0 and 2 and by layer 1 in steps 0 and 1.
    everywhere = [0, 1, 2, 3]
    mask = mask_from_steps([[0, 2], everywhere, everywhere, [0, 1], everywhere, everywhere], num_steps=4)
    step, column = reuse_source(mask, "type")
    source = (100 * step + column).tolist()
    # Step 1: layer 0 reads what layer 1 wrote in step 0. Step 2: layer 1 reads what layer 0 just wrote.
    # Step 3: both read it still.
    assert [row[0] for row in source] == [0, 3, 200, 200]
    assert [row[3] for row in source] == [3, 103, 200, 200]


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_reuse_source_is_per_row_and_points_to_computed_blocks_only(reuse):
    masks = random_mask(4, rate=0.8)
    step, column = reuse_source(masks, reuse)
    for row, mask in enumerate(masks):
        alone = reuse_source(mask, reuse)
        assert torch.equal(step[row], alone[0])
        assert torch.equal(column[row], alone[1])
        assert not mask[step[row], column[row]].any()
        if reuse != "single":
            assert (column[row] % 3 == torch.arange(6) % 3).all()


@pytest.mark.parametrize("reuse", ["block", "type", "single"])
def test_every_block_adds_what_reuse_source_says(ddpm, reuse):
    masks = random_mask(4, rate=0.7)
    step, column = reuse_source(masks, reuse)
    assert torch.equal(trace(ddpm, masks, reuse), (100 * step + column).float())


def test_type_reuse_equals_the_equation_of_sag(network, ddpm, query):
    """x <- x + (1-M) d + M tau; tau <- (1-M) d + M tau, with one tau for each type."""
    noise, cond = query
    masks = random_mask(5)
    sample = noise[:, 0]
    tau = [torch.zeros(())] * 3
    for k, timestep in enumerate(ddpm.timesteps.tolist()):
        x, memory = network.embed(sample), network.memory(timestep, cond)
        for b in range(NUM_BLOCKS):
            pruned = masks[:, k, b, None, None].float()
            tau[b % 3] = (1 - pruned) * network.block(b, x, memory) + pruned * tau[b % 3]
            x = x + tau[b % 3]
        sample = ddpm.step(network.head_out(x), k, sample, noise[:, k + 1] if k + 1 < NUM_STEPS else None)
    result = denoise(network, ddpm, noise, cond, masks, reuse="type")
    torch.testing.assert_close(result, sample, rtol=0, atol=1e-5)


def test_only_computed_blocks_of_computing_rows_are_run(network, ddpm, query, monkeypatch):
    masks, rows_run = random_mask(5), []
    block = network.block
    monkeypatch.setattr(network, "block", lambda b, x, m: rows_run.append(len(x)) or block(b, x, m))
    denoise(network, ddpm, *query, masks)
    assert sum(rows_run) == (~masks).sum().item()


def test_gradients_flow_through_computed_and_reused_outputs(network, ddpm, query):
    noise, cond = query
    cond = cond.requires_grad_()
    network.requires_grad_(True)
    masks = random_mask(5)
    masks[0, 1:] = True
    denoise(network, ddpm, noise, cond, masks).square().sum().backward()
    assert (cond.grad.abs().amax(dim=(1, 2)) > 0).all()
    for name, parameter in network.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


def test_a_dense_query_records_what_every_block_adds(network, ddpm, query):
    noise, cond = query
    recorder = FeatureRecorder()
    denoise(network, ddpm, noise, cond, record=recorder)
    features = recorder.features()
    assert features.shape == (NUM_BLOCKS, NUM_STEPS, 5, HORIZON, 32)
    x = network.embed(noise[:, 0]) + features[:, 0].sum(dim=0)
    eps = network(noise[:, 0], int(ddpm.timesteps[0]), cond)
    torch.testing.assert_close(network.head_out(x), eps)


@pytest.mark.parametrize(
    ("change", "entry"),
    [
        ({"noise": torch.zeros(5, 9, 6, 4)}, "noise"),
        ({"noise": torch.zeros(5, 10, 6, 3)}, "noise"),
        ({"cond": torch.zeros(5, 2, 7)}, "cond"),
        ({"mask": random_mask(4)}, "prune mask"),
        ({"mask": random_mask()}, "prune mask"),
        ({"mask": random_mask(5).float()}, "prune mask"),
        ({"mask": torch.ones(5, 10, 6, dtype=torch.bool)}, "prune mask"),
        ({"reuse": "layer"}, "reuse"),
    ],
)
def test_wrong_input_is_refused(network, ddpm, query, change, entry):
    arguments = {"noise": query[0], "cond": query[1], **change}
    with refused(entry):
        denoise(network, ddpm, **arguments)
