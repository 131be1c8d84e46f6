"""Several chunks a query: drawn with noises of their own, and the one played is the one that agrees most."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.control.realtime_executor import RealtimeExecutor
from torchrl_sparse.control.selectors import CoherentChunk, backward_coherence, disagreement
from torchrl_sparse.networks.diffusion.noise import NOISE_STREAM


class Drawing(TensorDictModuleBase):
    """Entry i of a chunk is the state plus i plus a number of the noise's stream, 5, 0, -1, ..."""

    in_keys = ["state", keys.EPISODE_SEED]
    out_keys = [keys.CHUNK, keys.FLOPS, keys.LATENCY]
    offsets = torch.tensor([5.0, 0.0, -1.0])

    def forward(self, td):
        offset = self.offsets[td[keys.EPISODE_SEED] // NOISE_STREAM]
        td[keys.CHUNK] = (td["state"] + offset + torch.arange(4.0))[..., None]
        td[keys.FLOPS] = torch.ones_like(td["state"])
        td[keys.LATENCY] = torch.full_like(td["state"], 0.5)
        return td


def played(executor, steps, resets=()):
    """What two samples, whose states are the step and ten more, play; `resets` are steps at which the second begins again."""
    td, actions, chosen = TensorDict(batch_size=[2]), [], []
    for step in range(steps):
        td["state"] = torch.tensor([[float(step)], [step + 10.0]])
        td[keys.IS_INIT] = torch.tensor([[step == 0], [step == 0 or step in resets]])
        td[keys.EPISODE_SEED] = torch.tensor([[3], [4]])
        td = executor(td)
        actions.append(td[keys.ACTION].flatten().tolist())
        chosen.append(td[keys.CHOSEN].flatten().tolist())
    return actions, chosen, td


def test_a_query_plays_the_sample_that_goes_on_as_the_last_one_did():
    executor = ChunkExecutor(Drawing(), 2, num_samples=3, selector=CoherentChunk())
    actions, chosen, td = played(executor, 4)
    assert chosen == [[0, 0]] * 4  # the first has nothing to agree with, and then 5 goes on with 5
    assert actions[2] == [7, 17]
    assert td[keys.FLOPS].flatten().tolist() == [0, 0]


def test_late_answers_are_chosen_among_too():
    hold = TensorDictModule(lambda state: state - 100, in_keys=["state"], out_keys=[keys.HOLD])
    options = {"num_samples": 3, "selector": CoherentChunk()}
    at_once = RealtimeExecutor(Drawing(), hold, 2, latency=0.0, **options)
    assert played(at_once, 6)[:2] == played(ChunkExecutor(Drawing(), 2, **options), 6)[:2]
    actions = played(RealtimeExecutor(Drawing(), hold, 2, latency=0.05, **options), 4)[0]
    # Held for a step; then the first sample, which 5 more than the state tells from the others, and on.
    assert actions == [[-100, -90], [6, 16], [7, 17], [8, 18]]


def test_the_samples_can_agree_among_themselves_and_a_new_episode_agrees_with_nothing_before():
    executor = ChunkExecutor(Drawing(), 2, num_samples=3, selector=CoherentChunk(agreement=1.0, backward=0.0))
    _, chosen, td = played(executor, 3)
    assert chosen[0] == [1, 1]  # 0 is nearer to 5 and -1 than those are to each other
    assert td[keys.FLOPS].flatten().tolist() == [3, 3]
    executor = ChunkExecutor(Drawing(), 2, num_samples=3, selector=CoherentChunk(agreement=1e-3))
    assert played(executor, 3)[1] == [[1, 1]] * 3
    far = ChunkExecutor(Drawing(), 2, num_samples=3, selector=CoherentChunk())
    td = played(far, 1)[2]
    td[keys.CHUNK] = td[keys.CHUNK] - 6  # as if both had played the third sample
    for begins, expected in ((False, [2, 2]), (True, [2, 0])):
        now = td.clone()
        now["state"], now[keys.AGE] = torch.tensor([[2.0], [12.0]]), torch.ones(2, 1).long()
        now[keys.IS_INIT] = torch.tensor([[False], [begins]])
        assert far(now)[keys.CHOSEN].flatten().tolist() == expected


def test_losses_are_the_sums_that_the_paper_writes():
    generator = torch.Generator().manual_seed(0)
    candidates, last = torch.randn(3, 4, 5, 2, generator=generator), torch.randn(3, 5, 2, generator=generator)
    elapsed = torch.tensor([[0], [2], [7]])
    found = backward_coherence(candidates, last, elapsed, 0.5)
    assert not found[0].any()
    assert not found[2].any()
    for sample in range(4):
        expected = sum(0.5**i * (candidates[1, sample, i] - last[1, 2 + i]).norm() for i in range(3))
        assert found[1, sample].item() == pytest.approx(expected.item(), rel=1e-5)
        others = [
            (candidates[1, sample] - candidates[1, o]).norm(dim=-1).mean() for o in range(4) if o != sample
        ]
        mean = sum(others).item() / 3
        assert disagreement(candidates)[1, sample].item() == pytest.approx(mean, rel=1e-5)


def test_numbers_out_of_range_are_named():
    with refused("num_samples"):
        ChunkExecutor(Drawing(), num_samples=4)
    with refused("num_samples"):
        ChunkExecutor(Drawing(), selector=CoherentChunk())
    with refused("decay"):
        CoherentChunk(decay=0)
