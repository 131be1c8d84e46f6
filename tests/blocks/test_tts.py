"""A pruner that also says what is recalled: its three logits, and its files."""

import json

import pytest
import torch
from tensordict import TensorDict

from tests.blocks.conftest import COND_DIM, NUM_LAYERS, NUM_STEPS, OBS_STEPS
from torchrl_sparse.blocks.planner import PlanSpec
from torchrl_sparse.blocks.sag.network import PrunerNetwork
from torchrl_sparse.blocks.sag.planner import PrunerInfo, SAGPruner
from torchrl_sparse.blocks.saved import load_planner
from torchrl_sparse.blocks.tts import TTSPruner
from torchrl_sparse.keys import COND, ELAPSED, PRUNE_MASK, QUERY, RECALL

SPEC = PlanSpec(NUM_STEPS, NUM_LAYERS, policy="8d1f", sampler="ddim")


def make_network(recalls=True, **options):
    torch.manual_seed(0)
    timesteps = list(range(90, -1, -10))
    return PrunerNetwork(timesteps, 3 * NUM_LAYERS, (OBS_STEPS, COND_DIM), recalls=recalls, **options)


def make_pruner():
    pruner = TTSPruner(make_network(), PrunerInfo("8d1f", "ddim", 0.7))
    pruner.bind(SPEC)
    return pruner


def later_queries(*batch):
    """Queries that are not the first of their episode."""
    cond = 5 * torch.randn(*batch, OBS_STEPS, COND_DIM, generator=torch.Generator().manual_seed(1))
    asked = {
        COND: cond,
        ELAPSED: torch.full((*batch, 1), 8),
        QUERY: torch.zeros(*batch, 1, dtype=torch.int64),
    }
    return TensorDict(asked, batch)


@torch.no_grad()
def test_cells_are_pruned_and_recalled_as_the_three_logits_say():
    pruner = make_pruner()
    td = pruner(later_queries(16))
    keep, prune, recall = pruner.network(td[COND]).unbind(-1)
    mask = prune > keep
    mask[:, 0] = False
    assert torch.equal(td[PRUNE_MASK], mask)
    assert torch.equal(td[RECALL], mask & (recall > 0))
    assert 0 < td[RECALL].sum() < mask.sum()
    assert (td[QUERY] == 1).all()


def test_a_row_equals_the_row_alone_whatever_the_batch_dimensions():
    pruner, queries = make_pruner(), later_queries(4, 3)
    together = pruner(queries.clone())
    alone = torch.stack([pruner(row.clone()) for row in queries.flatten()]).reshape(4, 3)
    for key in (PRUNE_MASK, RECALL, QUERY):
        assert torch.equal(together[key], alone[key])


def test_the_first_query_of_an_episode_computes_everything():
    queries = later_queries(16)
    later = make_pruner()(queries.clone())
    begins = later[RECALL].flatten(1).any(dim=1)
    queries[ELAPSED][begins] = 0
    td = make_pruner()(queries)
    assert 0 < begins.sum() < 16
    for key in (PRUNE_MASK, RECALL):
        assert not td[key][begins].any()
        assert torch.equal(td[key][~begins], later[key][~begins])
    assert torch.equal(td[QUERY].flatten(), 1 - begins.long())


def test_two_logits_of_a_network_that_recalls_are_those_of_one_that_does_not():
    recalling, plain = make_network(), make_network(recalls=False)
    state = recalling.state_dict()
    state |= {name: state[name][:2] for name in ("mlp.3.weight", "mlp.3.bias")}
    plain.load_state_dict(state)
    cond = later_queries(16)[COND]
    with torch.no_grad():
        for network in (plain.eval(), recalling.eval()):
            network.logits = network.prune_logits(cond)
    assert torch.equal(plain.logits, recalling.logits)
    assert recalling.macs_per_query > plain.macs_per_query


def test_its_files_are_read_by_their_format(tmp_path):
    pruner = make_pruner()
    pruner.save_pretrained(tmp_path / "tts")
    read = load_planner(tmp_path / "tts", SPEC)
    assert type(read) is TTSPruner
    assert (read.fingerprint, read.info) == (pruner.fingerprint, pruner.info)
    queries = later_queries(5)
    assert torch.equal(read(queries.clone())[RECALL], pruner(queries.clone())[RECALL])
    with pytest.raises(
        ValueError, match=r"config.json: format: expected 'torchrl_sparse.sag/1', got .*tts/1"
    ):
        SAGPruner.from_pretrained(tmp_path / "tts")
    config = tmp_path / "tts" / "config.json"
    stored = json.loads(config.read_text())
    stored["network"]["recalls"] = "yes"
    config.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"config.json: network: recalls: expected true or false, got 'yes'"):
        load_planner(tmp_path / "tts")


@pytest.mark.parametrize("options", [{"recalls": False}, {"rate_input": True}])
def test_a_network_of_another_kind_is_refused(options):
    with pytest.raises(ValueError, match="network: expected recalls=True and rate_input=False, got"):
        TTSPruner(make_network(**options), PrunerInfo("8d1f", "ddim", 0.7))
