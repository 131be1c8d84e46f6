"""Attention in both directions, positions, scores, and what dropping tokens leaves untouched."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from transformers import LlamaConfig, LlamaModel

from tests.refusals import refused
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.decoder import BidirectionalLlama, pack, row_attention
from torchrl_sparse.networks.vla.hooks import LayerHooks, LayerState, TokenKind

BATCH, VISUAL, TEXT, SLOTS = 3, 8, 4, 14


@pytest.fixture
def decoder():
    torch.manual_seed(0)
    return BidirectionalLlama(VLAConfig.tiny()).eval()


@pytest.fixture
def sequence():
    """``BOS | 4 primary | 4 wrist | proprio | text | slots | stop`` of random embeddings."""
    torch.manual_seed(1)
    counts = [1, 4, 4, 1, TEXT, SLOTS, 1]
    kind = torch.arange(7).repeat_interleave(torch.tensor(counts)).expand(BATCH, -1)
    length = kind.shape[1]
    hidden = torch.randn(BATCH, length, 32)
    alive = torch.ones(BATCH, length, dtype=torch.bool)
    positions = torch.arange(length).expand(BATCH, -1)
    td = TensorDict({}, [BATCH])
    return LayerState(0, hidden, alive, positions, kind, kind == TokenKind.TEXT, VISUAL, td)


class Drop(LayerHooks):
    """Drops visual tokens ``ids`` after a layer; remembers every state that it is shown."""

    def __init__(self, layer, ids, rows=BATCH):
        self.layer, self.ids, self.rows, self.states = layer, ids, rows, []

    def layers_scored(self, num_layers):
        return set(range(num_layers))

    def after_layer(self, index, state):
        self.states.append(state)
        if index != self.layer:
            return None
        keep = torch.ones(self.rows, VISUAL, dtype=torch.bool)
        for row, ids in enumerate(self.ids):
            keep[row, ids] = False
        return state.keep_visual(keep)


def manual_attention(llama, hidden, causal):
    """Hugging Face's own Llama, eager, with the mask that is asked for."""
    length = hidden.shape[1]
    mask = torch.zeros(1, 1, length, length)
    if causal:
        mask = mask.masked_fill(torch.ones(length, length).triu(1).bool(), -torch.inf)
    rotary = llama.rotary_emb(hidden, torch.arange(length)[None])
    for layer in llama.layers:
        hidden = layer(hidden, attention_mask=mask, position_embeddings=rotary)
    return llama.norm(hidden)


@pytest.fixture
def reference(decoder):
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 4, "num_attention_heads": 2}
    llama = LlamaModel(LlamaConfig(vocab_size=320, **sizes, attn_implementation="eager"))
    llama.load_state_dict(decoder.llama.state_dict())
    return llama.eval()


@torch.no_grad()
def test_it_is_llama_without_the_causal_mask(decoder, reference, sequence):
    ours = decoder(sequence).hidden
    torch.testing.assert_close(ours, manual_attention(reference, sequence.hidden, causal=False))
    assert (ours - manual_attention(reference, sequence.hidden, causal=True)).abs().max() > 0.1


@torch.no_grad()
def test_a_later_token_changes_an_earlier_output(decoder, sequence):
    before = decoder(sequence).hidden
    sequence.hidden = sequence.hidden.clone()
    sequence.hidden[:, -1] += 1.0
    after = decoder(sequence).hidden
    assert ((after - before)[:, 0].abs().amax(-1) > 1e-3).all()


@torch.no_grad()
@pytest.mark.parametrize("layer", range(4))
def test_keeping_all_is_dense_bit_by_bit(decoder, sequence, layer):
    dense = decoder(sequence)
    pruned = decoder(sequence, Drop(layer, [[], [], []]))
    assert torch.equal(pruned.hidden, dense.hidden)


@torch.no_grad()
def test_positions_stay_and_only_visual_tokens_go(decoder, sequence):
    class Everything(LayerHooks):
        def after_layer(self, index, state):
            self.state = state
            return torch.zeros_like(state.alive)

    pruner = Everything()
    decoded = decoder(sequence, pruner)
    assert pruner.state.positions.tolist() == [[0, *range(9, 29)]] * BATCH
    assert pruner.state.kind[0].unique().tolist() == [0, 3, 4, 5, 6]
    assert decoded.tokens.tolist() == [[29, 21, 21, 21]] * BATCH
    assert decoded.depth.tolist() == [[1] * VISUAL] * BATCH


@torch.no_grad()
def test_dropping_is_masking_out(decoder, reference, sequence):
    """Against a reference that keeps all tokens but lets nobody attend to the dropped ones in the layers after."""
    dropped = [[0, 5], [3], []]
    ours = decoder(sequence, Drop(1, dropped))
    hidden, length = sequence.hidden, sequence.hidden.shape[1]
    hide = torch.zeros(BATCH, 1, 1, length)
    for row, ids in enumerate(dropped):
        hide[row, ..., [1 + i for i in ids]] = -torch.inf
    rotary = reference.rotary_emb(hidden, torch.arange(length)[None])
    for index, layer in enumerate(reference.layers):
        mask = hide if index > 1 else torch.zeros_like(hide)
        hidden = layer(hidden, attention_mask=mask, position_embeddings=rotary)
    hidden = reference.norm(hidden)
    for row, ids in enumerate(dropped):
        kept = [i for i in range(length) if i - 1 not in ids]
        torch.testing.assert_close(ours.hidden[row, : len(kept)], hidden[row, kept])
    assert ours.lengths.tolist() == [27, 28, 29]
    assert ours.tokens[0].tolist() == [29, 29, 27, 27]
    assert ours.depth[0].tolist() == [2, 4, 4, 4, 4, 2, 4, 4]


def test_training_in_bf16_on_a_cpu_has_the_gradient_of_the_whole_precision(decoder, sequence):
    """Rows of several lengths, so that attention is masked: the plain products of training, against PyTorch's own."""

    def gradients(bf16):
        decoder.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            decoded = decoder(sequence, Drop(1, [[0, 5], [3], []]))
        real = torch.arange(decoded.hidden.shape[1]) < decoded.lengths[:, None]
        (decoded.hidden.float() * real[..., None]).pow(3).mean().backward()
        layers = [layer.self_attn for layer in decoder.llama.layers]
        return torch.cat([a.q_proj.weight.grad.ravel() for a in layers])

    exact, rounded = gradients(False), gradients(True)
    assert torch.cosine_similarity(exact, rounded, dim=0) > 0.995
    assert 0.95 < rounded.norm() / exact.norm() < 1.05


@torch.no_grad()
def test_scores_are_the_attention_of_the_text_under_original_ids(decoder, reference, sequence):
    pruner = Drop(0, [[0, 5], [3], [7, 6, 1]])
    decoder(sequence, pruner)
    first, second = pruner.states[:2]
    rotary = reference.rotary_emb(sequence.hidden, torch.arange(29)[None])
    layer = reference.layers[0]
    _, weights = layer.self_attn(layer.input_layernorm(sequence.hidden), rotary, torch.zeros(1, 1, 29, 29))
    text = slice(10, 10 + TEXT)
    torch.testing.assert_close(first.scores, weights[:, :, text, 1:9].mean((1, 2)))
    torch.testing.assert_close(first.attention.mean(1), first.scores)
    assert (second.scores == 0).nonzero().tolist() == [[0, 0], [0, 5], [1, 3], [2, 1], [2, 6], [2, 7]]
    assert torch.equal(second.scores != 0, second.visual_alive)


@torch.no_grad()
def test_only_scored_layers_are_scored_and_skipped_layers_do_not_run(decoder, sequence):
    class Sparse(Drop):
        def layers_scored(self, num_layers):
            return {1}

        def layers_skipped(self, num_layers):
            return {0, 2}

    pruner = Sparse(1, [[0], [0], [0]])
    decoded = decoder(sequence, pruner)
    assert [(state.layer, state.scores is None) for state in pruner.states] == [(1, False), (3, True)]
    assert decoded.tokens[0].tolist() == [0, 29, 0, 28]
    assert decoded.scored.tolist() == [TEXT * 29] * BATCH
    assert decoded.depth[0].tolist() == [1] + [2] * 7


def test_pack_keeps_the_order_of_each_row(sequence):
    alive = torch.rand(BATCH, 29, generator=torch.Generator().manual_seed(0)) < 0.6
    packed, mask = pack(sequence, alive)
    assert packed.hidden.shape[1] == alive.sum(1).max()
    for row in range(BATCH):
        length = int(alive[row].sum())
        assert torch.equal(packed.hidden[row, :length], sequence.hidden[row, alive[row]])
        assert torch.equal(packed.positions[row, :length], sequence.positions[row, alive[row]])
        assert mask[row].sum() == length


def test_rows_that_a_sample_lacks_have_no_attention():
    torch.manual_seed(0)
    query, key = torch.randn(2, 2, 3, 6, 4).unbind()
    rows = torch.tensor([[1, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]], dtype=torch.bool)
    alive = torch.tensor([[1] * 6, [1, 1, 0, 1, 1, 1]], dtype=torch.bool)
    weights = row_attention(query, key, rows, alive)
    assert weights.shape == (2, 2, 6)
    torch.testing.assert_close(weights.sum(-1), torch.tensor([[1.0, 1.0], [1.0, 0.0]]))
    assert weights[1, 0, 2] == 0
    expected = (query[0, :, 2] * key[0].transpose(0, 1) / 2).sum(-1).softmax(0).mean(1)
    torch.testing.assert_close(weights[0, 1], expected)


# -- heads that share keys and values ----------------------------------------------------------------------------------


@pytest.fixture
def grouped():
    """Four heads over two of keys and values, with another rope base and epsilon."""
    torch.manual_seed(0)
    config = VLAConfig.tiny(llm=TransformerSize(32, 4, 4, 64), kv_heads=2, rope_base=1e5, norm_eps=1e-5)
    return BidirectionalLlama(config).eval()


@torch.no_grad()
def test_shared_keys_and_values_are_those_of_a_decoder_that_has_them_twice(grouped, sequence):
    same = {"rope_base": 1e5, "norm_eps": 1e-5}
    each = BidirectionalLlama(VLAConfig.tiny(llm=TransformerSize(32, 4, 4, 64), **same)).eval()
    weights = grouped.llama.state_dict()
    for name in [name for name in weights if "k_proj" in name or "v_proj" in name]:
        weights[name] = weights[name].unflatten(0, (2, 8)).repeat_interleave(2, dim=0).flatten(0, 1)
    each.llama.load_state_dict(weights)
    ours, theirs = (Drop(1, [[0, 5], [3], []]) for _ in range(2))
    torch.testing.assert_close(grouped(sequence, ours).hidden, each(sequence, theirs).hidden)
    for mine, other in zip(ours.states, theirs.states, strict=True):
        torch.testing.assert_close(mine.attention, other.attention)


@torch.no_grad()
def test_it_is_transformers_llama_with_those_sizes(grouped, sequence):
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 4, "num_attention_heads": 4}
    other = {"num_key_value_heads": 2, "rope_parameters": {"rope_type": "default", "rope_theta": 1e5}}
    config = LlamaConfig(vocab_size=320, **sizes, **other, rms_norm_eps=1e-5, attn_implementation="eager")
    llama = LlamaModel(config)
    llama.load_state_dict(grouped.llama.state_dict())
    expected = manual_attention(llama.eval(), sequence.hidden, causal=False)
    torch.testing.assert_close(grouped(sequence).hidden, expected)


@torch.no_grad()
def test_a_row_with_shared_heads_is_the_row_alone(grouped, sequence):
    together = grouped(sequence, Drop(1, [[0, 5], [3], []]))
    for row, ids in enumerate([[0, 5], [3], []]):
        names = ("hidden", "alive", "positions", "kind", "task", "td")
        alone = replace(sequence, **{name: getattr(sequence, name)[row : row + 1] for name in names})
        length = together.lengths[row]
        mine = grouped(alone, Drop(1, [ids], rows=1)).hidden[0, :length]
        torch.testing.assert_close(together.hidden[row, :length], mine, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"kv_heads": 3}, "kv_heads"),
        ({"kv_heads": 0}, "kv_heads"),
        ({"rope_base": 0.0}, "rope_base"),
        ({"norm_eps": float("inf")}, "norm_eps"),
    ],
)
def test_sizes_that_no_decoder_has_are_named(changes, entry):
    with refused(entry):
        VLAConfig.tiny(**changes)


def test_files_say_what_is_not_as_it_was_from_the_first():
    assert not {"kv_heads", "rope_base", "norm_eps"} & VLAConfig.tiny().to_dict().keys()
    config = VLAConfig.tiny(kv_heads=1, norm_eps=1e-5)
    assert config.to_dict()["kv_heads"] == 1
    assert VLAConfig.from_dict(config.to_dict()) == config
