"""A language model in a GGUF file: what is read, what is refused, and SmolLM2 itself where its file is there."""

import os

import gguf
import numpy as np
import pytest
import torch
from transformers import LlamaConfig, LlamaForCausalLM

from tests.fixtures.gguf import (
    METADATA,
    SIZES,
    gguf_bytes,
    llama_tensors,
    q4_1,
    q8_0,
    tiny_weights,
    write_llama,
)
from tests.refusals import refused
from torchrl_sparse.storage.gguf import GGUF
from torchrl_sparse.storage.language_model import read_language_model


@pytest.fixture
def file(tmp_path):
    return write_llama(tmp_path / "tiny.gguf")


def test_sizes_weights_and_words_come_back(file):
    model = read_language_model(file)
    assert {name: model.sizes[name] for name in SIZES} == SIZES
    expected = tiny_weights()
    assert model.weights.keys() == expected.keys()
    assert all(torch.equal(model.weights[name], value) for name, value in expected.items())
    prompts = model.tokenizer.encode(["lift the cube", "go"])
    assert prompts.task.sum(1).tolist() == [4 + 1 + 5, 2]  # l i f t, the, a space and c u b e; a space, go
    assert prompts.ids.max() < model.sizes["vocab_size"]


@pytest.mark.parametrize(("kind", "quantise"), [(3, q4_1), (8, q8_0)])
def test_quantised_tensors_are_what_their_blocks_mean(tmp_path, kind, quantise):
    data, expected = quantise(np.random.default_rng(0).normal(size=(6, 64)).astype("f4"))
    (tmp_path / "a.gguf").write_bytes(gguf_bytes({}, {"w": (kind, (6, 64), data)}))
    assert np.array_equal(GGUF(tmp_path / "a.gguf").tensor("w").numpy(), expected)


def test_the_package_gguf_reads_the_same(tmp_path):
    tensors = llama_tensors(tiny_weights())
    for kind, quantise in ((3, q4_1), (8, q8_0)):
        tensors[f"more.{kind}"] = (
            kind,
            (4, 32),
            quantise(np.random.default_rng(kind).normal(size=(4, 32)))[0],
        )
    (tmp_path / "a.gguf").write_bytes(gguf_bytes(METADATA, tensors))
    ours = GGUF(tmp_path / "a.gguf")
    for tensor in gguf.GGUFReader(tmp_path / "a.gguf").tensors:
        values = gguf.dequantize(tensor.data, tensor.tensor_type)
        assert np.array_equal(ours.tensor(tensor.name).numpy().ravel(), values.ravel()), tensor.name


@pytest.mark.parametrize(
    ("changes", "entry"),
    [
        ({"architecture": "gemma"}, "other.gguf: general.architecture"),
        ({"pre": "llama-bpe"}, "other.gguf: tokenizer.ggml.pre"),
        ({"bos_token_id": 5}, "other.gguf: tokenizer.ggml.bos_token_id"),
        ({"head_count": None}, "other.gguf: llama.attention.head_count"),
        ({"head_count": 3}, "other.gguf: dim"),
        ({"block_count": 1 << 30}, "other.gguf: layers"),
        ({"embedding_length": 64}, "other.gguf: embed_tokens.weight"),
        ({"freq_base": 0.0}, "other.gguf: rope_base"),
        ({"tokens": ["a"] * 10}, "other.gguf: embed_tokens.weight"),
        ({"merges": ["no such"]}, "other.gguf: tokenizer.ggml"),
    ],
)
def test_other_models_are_named(tmp_path, changes, entry):
    file = write_llama(tmp_path / "other.gguf", **changes)
    with refused(entry) as caught:
        read_language_model(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.01, 0.1, 0.3, 0.5, 0.9, 0.999])
def test_a_file_that_is_cut_off_is_one_line(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with refused("tiny.gguf") as caught:
        read_language_model(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("at", range(0, 200, 7))
def test_a_damaged_header_is_one_line_and_takes_no_memory(file, at):
    content = bytearray(file.read_bytes())
    content[at : at + 8] = b"\xff" * 8
    file.write_bytes(bytes(content))
    with refused("tiny.gguf") as caught:
        read_language_model(file)
    assert "\n" not in str(caught.value)


def test_a_missing_file_a_foreign_one_and_an_unknown_type_are_named(tmp_path):
    with refused("none.gguf", FileNotFoundError):
        read_language_model(tmp_path / "none.gguf")
    (tmp_path / "a.gguf").write_bytes(b"PK\x03\x04" + bytes(100))
    with refused("a.gguf"):
        read_language_model(tmp_path / "a.gguf")
    (tmp_path / "a.gguf").write_bytes(gguf_bytes({}, {"w": (12, (1, 256), bytes(144))}))
    with refused("a.gguf: w"):
        GGUF(tmp_path / "a.gguf").tensor("w")


@pytest.fixture(scope="module")
def smollm2():
    path = os.environ.get("SMOLLM2_GGUF", "")
    if not os.path.isfile(path):
        pytest.skip("SMOLLM2_GGUF does not name SmolLM2-135M-Instruct.Q4_1.gguf")
    return read_language_model(path)


@pytest.fixture(scope="module")
def causal(smollm2):
    """transformers' own Llama with the same weights."""
    sizes = smollm2.sizes
    llm = sizes["llm"]
    config = LlamaConfig(
        vocab_size=sizes["vocab_size"],
        hidden_size=llm.dim,
        intermediate_size=llm.mlp,
        num_hidden_layers=llm.layers,
        num_attention_heads=llm.heads,
        num_key_value_heads=sizes["kv_heads"],
        rms_norm_eps=sizes["norm_eps"],
        rope_parameters={"rope_type": "default", "rope_theta": sizes["rope_base"]},
        tie_word_embeddings=True,
        attn_implementation="eager",
    )
    llama = LlamaForCausalLM(config).eval()
    llama.model.load_state_dict(smollm2.weights)
    llama.tie_weights()
    return llama


@pytest.mark.parametrize(
    ("prompt", "answer"), [("The capital of France is", " Paris"), ("The opposite of hot is", " cold")]
)
def test_smollm2_knows_what_it_knew(smollm2, causal, prompt, answer):
    tokenizer = smollm2.tokenizer._tokenizer
    with torch.no_grad():
        logits = causal(torch.tensor([tokenizer.encode(prompt).ids])).logits
    assert tokenizer.decode([int(logits[0, -1].argmax())]) == answer


@torch.no_grad()
def test_smollm2_is_transformers_llama_without_the_causal_mask(smollm2, causal):
    from tests.networks.vla.test_decoder import manual_attention
    from torchrl_sparse.networks.vla.config import VLAConfig
    from torchrl_sparse.networks.vla.decoder import BidirectionalLlama
    from torchrl_sparse.networks.vla.hooks import LayerState

    ours = BidirectionalLlama(VLAConfig.tiny(**smollm2.sizes)).eval()
    ours.llama.load_state_dict(smollm2.weights)
    ids = smollm2.tokenizer.encode(["lift the red cube and put it down"]).ids
    hidden, positions = ours.embed(ids), torch.arange(ids.shape[1])[None]
    everything = torch.ones_like(ids, dtype=torch.bool)
    state = LayerState(0, hidden, everything, positions, torch.full_like(ids, 4), everything, 0, None)
    mine = causal.lm_head(ours(state).hidden)
    theirs = causal.lm_head(manual_attention(causal.model, hidden, causal=False))
    torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)
