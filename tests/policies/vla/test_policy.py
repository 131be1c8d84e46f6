"""The policy as a TensorDictModule: rows, masks, pruners, costs, errors."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, SerialEnv, TransformedEnv
from torchrl.envs.custom import ToyVLAEnv

from tests.refusals import refused
from torchrl_sparse import keys
from torchrl_sparse.control.chunk_executor import ChunkExecutor
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.flops import query_flops
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner


def keep(batch, *rows):
    """bool [batch, 8]: row i keeps the ids in ``rows[i]``."""
    mask = torch.zeros(batch, 8, dtype=torch.bool)
    for row, ids in enumerate(rows):
        mask[row, list(ids)] = True
    return mask


@torch.no_grad()
def test_writes_what_it_declares_and_nothing_else(policy, query):
    td = policy(query(3))
    there = set(td.keys(include_nested=True, leaves_only=True))
    assert there == {*query(3).keys(include_nested=True, leaves_only=True), *policy.out_keys}
    assert td[keys.CHUNK].shape == (3, 2, 7)
    assert td[keys.CHUNK].dtype == torch.float32
    assert set(td[keys.CHUNK][..., 6].unique().tolist()) <= {-1.0, 1.0}
    assert (td[keys.LATENCY] > 0).all()


@torch.no_grad()
@pytest.mark.parametrize("masked", [False, True])
def test_row_equals_alone(policy, query, masked):
    td = query(3)
    if masked:
        td[keys.KEEP_MASK] = keep(3, range(8), [0, 5], [7])
    together = policy(td.clone())
    for row in range(3):
        alone = policy(td[row : row + 1].clone())
        torch.testing.assert_close(alone[keys.CHUNK], together[row : row + 1][keys.CHUNK], rtol=0, atol=1e-5)
        for key in (keys.FLOPS, keys.KEPT, keys.TOKEN_DEPTH):
            assert torch.equal(alone[key], together[row : row + 1][key]), key


@torch.no_grad()
def test_any_batch_shape(policy, query):
    flat = policy(query(4))[keys.CHUNK]
    torch.testing.assert_close(policy(query(4).reshape(2, 2))[keys.CHUNK], flat.reshape(2, 2, 2, 7))
    torch.testing.assert_close(policy(query(4)[1])[keys.CHUNK], flat[1], rtol=0, atol=1e-5)


@torch.no_grad()
def test_keep_all_is_dense_bit_by_bit(policy, query):
    td = query(3)
    td[keys.KEEP_MASK] = torch.ones(3, 8, dtype=torch.bool)
    assert torch.equal(policy(td)[keys.CHUNK], policy(query(3))[keys.CHUNK])


@torch.no_grad()
def test_a_pruned_image_patch_cannot_matter(policy, query):
    """The 14 x 14 patch at row 1, column 0 of the wrist camera is visual token 4 + 2."""
    before, after = query(1), query(1)
    after["observation", "wrist_image"][..., 14:, :14] ^= 255
    assert (policy(before)[keys.CHUNK] != policy(after)[keys.CHUNK]).any()
    # the towers mix patches, so every token of that camera has to go before the patch is out of sight
    for td in (before, after):
        td[keys.KEEP_MASK] = keep(1, range(4))
    assert torch.equal(policy(before)[keys.CHUNK], policy(after)[keys.CHUNK])
    for td in (before, after):
        td[keys.KEEP_MASK] = keep(1, [*range(4), 6])
    assert (policy(before)[keys.CHUNK] != policy(after)[keys.CHUNK]).any()


@torch.no_grad()
def test_every_input_matters(policy, query):
    dense = policy(query(1))[keys.CHUNK]
    for key in (keys.IMAGE, keys.WRIST_IMAGE, keys.STATE):
        td = query(1)
        td[key] = td[key] // 2 if td[key].dtype == torch.uint8 else td[key] - 1
        assert (policy(td)[keys.CHUNK] - dense).abs().max() > 1e-4, key
    assert (policy(query(1, ["stack the cube"]))[keys.CHUNK] - dense).abs().max() > 1e-4


class Recorder(TokenPruner):
    """Keeps every second visual token after layer 1, and carries the scores to the next policy call."""

    in_keys = [keys.TOKEN_SCORE, keys.IS_INIT]
    out_keys = [keys.TOKEN_SCORE]

    def layers_scored(self, num_layers):
        return {1}

    def begin(self, td):
        before = td.get(keys.TOKEN_SCORE, None)
        td["carried"] = torch.zeros(*td.shape, 8) if before is None else before
        if keys.IS_INIT in td.keys(True):
            td["carried"] = td["carried"] * ~td[keys.IS_INIT]

    def after_layer(self, index, state):
        if index != 1:
            return None
        state.td["carried"] = state.td["carried"] + state.scores
        return state.keep_visual(torch.arange(8).expand(len(state.hidden), -1) % 2 == 0)

    def end(self, td):
        td[keys.TOKEN_SCORE] = td["carried"]


@torch.no_grad()
def test_a_pruner_carries_state_in_keys_alone(policy, query):
    policy.pruner = Recorder()
    assert keys.TOKEN_SCORE in policy.in_keys
    assert keys.TOKEN_SCORE in policy.out_keys
    td = policy(query(2))
    first = td[keys.TOKEN_SCORE].clone()
    assert "carried" not in td
    assert (first > 0).all()
    td[keys.IS_INIT] = torch.tensor([[False], [True]])
    second = policy(td)[keys.TOKEN_SCORE]
    torch.testing.assert_close(second, torch.stack([2 * first[0], first[1]]))
    assert td[keys.TOKEN_DEPTH].tolist() == [[4, 2] * 4] * 2
    assert td[keys.KEPT].tolist() == [[6.0]] * 2
    policy.pruner = None
    assert keys.TOKEN_SCORE not in policy.in_keys


@torch.no_grad()
def test_flops_are_those_of_the_tokens_that_ran(policy, query):
    text = "lift the cube"
    prompt = int(policy.tokenizer.encode([text]).mask.sum())
    length = 1 + 8 + 1 + prompt + 14 + 1
    config, none = policy.network.config, torch.tensor([0])
    dense = policy(query(1, [text]))
    assert torch.equal(dense[keys.FLOPS][0], query_flops(config, torch.full((1, 4), length), none))
    policy.pruner = Recorder()
    pruned = policy(query(1, [text]))
    tokens, scored = torch.tensor([[length, length, length - 4, length - 4]]), torch.tensor([3 * length])
    assert torch.equal(pruned[keys.FLOPS][0], query_flops(config, tokens, scored))
    assert pruned[keys.FLOPS] < dense[keys.FLOPS]


def test_a_pruner_that_does_not_fit_is_refused_and_the_old_one_stays(policy):
    class TooMuch(TokenPruner):
        def bind(self, spec):
            raise ValueError(f"budget: expected at most {spec.num_visual} tokens, got 9")

    policy.pruner = old = TokenPruner()
    with pytest.raises(ValueError, match="at most 8 tokens"):
        policy.pruner = TooMuch()
    assert policy.pruner is old


def test_a_missing_out_key_of_a_pruner_is_named(policy, query):
    policy.pruner = pruner = Recorder()
    pruner.end = lambda td: None
    with pytest.raises(KeyError, match=r"tokens.*score"):
        policy(query(1))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (keys.WRIST_IMAGE, None, "wrist_image.*observation.*image"),
        (keys.STATE, None, "state"),
        (keys.INSTRUCTION, None, "language_instruction"),
        (keys.IMAGE, torch.zeros(1, 3, 28, 28), r"image.*uint8 \[\*B, 3, 28, 28\].*float32"),
        (keys.IMAGE, torch.zeros(1, 3, 14, 28, dtype=torch.uint8), r"image.*3, 28, 28.*\[1, 3, 14, 28\]"),
        (keys.STATE, torch.zeros(1, 9), r"state.*\[\*B, 8\].*\[1, 9\]"),
        (keys.STATE, torch.full((1, 8), torch.nan), "finite"),
        (keys.KEEP_MASK, torch.ones(1, 9, dtype=torch.bool), r"keep_mask.*\[\*B, 8\].*\[1, 9\]"),
        (keys.KEEP_MASK, torch.ones(1, 8), r"keep_mask.*bool.*float32"),
        (keys.INSTRUCTION, torch.zeros(1, 3), "language_instruction.*expected text"),
    ],
)
def test_wrong_inputs_are_named(policy, query, key, value, message):
    td = query(1)
    if value is None:
        td.pop(key)
    else:
        td[key] = value
    with pytest.raises((KeyError, TypeError, ValueError), match=message):
        policy(td)


def test_a_tokenizer_with_too_many_ids_is_refused(network):
    words = [f"word{i}" for i in range(100)]
    with refused("tokenizer"):
        VLAPolicy(network, tokenizer=WordTokenizer(words))


@torch.no_grad()
def test_one_camera(query):
    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(cameras=(keys.IMAGE,))))
    td = query(2)
    td.pop(keys.WRIST_IMAGE)
    assert keys.WRIST_IMAGE not in policy.in_keys
    assert policy(td)[keys.TOKEN_DEPTH].shape == (2, 4)


def test_gradients_reach_every_weight_but_those_that_nothing_reads(policy, query):
    policy.train()
    policy(query(3))[keys.CHUNK][..., :6].sum().backward()
    without = {name for name, p in policy.network.named_parameters() if p.grad is None}
    assert without == {"vision.dino.embeddings.mask_token"}


@torch.no_grad()
def test_half_precision_network(policy, query):
    td = query(3)
    td[keys.KEEP_MASK] = keep(3, range(8), [0, 5], [7])
    full = policy(td.clone())[keys.CHUNK]
    policy.network.bfloat16()
    half = policy(td)[keys.CHUNK]
    assert half.dtype == torch.float32
    torch.testing.assert_close(half[..., :6], full[..., :6], rtol=0, atol=0.1)
    assert not torch.equal(half, full)


def test_collector_with_the_chunk_executor(config):
    def env():
        sizes = {"action_dim": 7, "state_dim": 8, "image_shape": (3, 28, 28)}
        return TransformedEnv(ToyVLAEnv(**sizes, device="cpu"), InitTracker())

    policy = VLAPolicy(VLANetwork(VLAConfig.tiny(cameras=(keys.IMAGE,))))
    policy.pruner = HalfOfFour()
    actor = ChunkExecutor(policy, n_action_steps=2)
    collector = Collector(lambda: SerialEnv(2, env), actor, frames_per_batch=8, total_frames=8)
    steps = next(iter(collector))
    collector.shutdown()
    queried = steps[keys.QUERIED].squeeze(-1)
    assert queried.tolist() == [[True, False] * 2] * 2
    assert ((steps[keys.FLOPS].squeeze(-1) > 0) == queried).all()
    assert (steps[keys.KEPT] == 3).all()
    assert not set(actor.out_keys) - set(steps.keys(True, True))


class HalfOfFour(TokenPruner):
    def after_layer(self, index, state):
        return state.keep_visual(torch.arange(4).expand(len(state.hidden), -1) < 2) if index == 1 else None


@torch.no_grad()
def test_the_input_is_not_changed_by_a_pruner_that_writes_a_mask(policy, query):
    class First(TokenPruner):
        def begin(self, td):
            td[keys.KEEP_MASK] = torch.arange(8).expand(*td.shape, -1) < 4

    policy.pruner = First()
    td = policy(query(2))
    assert td[keys.TOKEN_DEPTH].tolist() == [[4] * 4 + [0] * 4] * 2
    assert keys.KEEP_MASK not in td.keys(True)


def test_one_instruction_serves_a_batch(policy, query):
    td = TensorDict({"observation": query(2)["observation"], "language_instruction": "stack"}, [2])
    torch.testing.assert_close(policy(td)[keys.CHUNK], policy(query(2, ["stack"]))[keys.CHUNK])


def test_an_empty_batch_is_refused_by_name(policy, query):
    with refused("batch"):
        policy(query(2)[:0])
