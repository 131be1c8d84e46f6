"""Prompts: which ids belong to the instruction, padding, unknown words."""

import json

import pytest
import torch
from tokenizers import Tokenizer, models, pre_tokenizers

from tests.refusals import refused
from torchrl_sparse.networks.vla.text import LlamaTokenizer, WordTokenizer, tokenizer_from_config


def test_rows_are_padded_at_the_end_and_the_task_is_marked():
    tokenizer = WordTokenizer(["lift", "cube"])
    both = tokenizer.encode(["Lift the cube", "lift"])
    alone = tokenizer.encode(["lift"])
    length = int(alone.mask.sum())
    assert torch.equal(both.ids[1, :length], alone.ids[0])
    assert both.mask[1].tolist() == [True] * length + [False] * 2
    assert both.task.sum(1).tolist() == [3, 1]
    assert not (both.task & ~both.mask).any()


def test_unknown_words_are_spelt_and_differ():
    tokenizer = WordTokenizer(["lift"])
    assert int(tokenizer.encode(["lift ärm"]).task.sum()) == 1 + len("ärm".encode())
    first, second = tokenizer.encode(["red"]), tokenizer.encode(["blu"])
    assert not torch.equal(first.ids, second.ids)


def test_ids_stay_in_the_vocabulary_and_do_not_depend_on_the_order_of_words():
    tokenizer = WordTokenizer(["b", "a", "A", "action"])
    assert tokenizer.words == ["a", "b"]
    ids = tokenizer.encode(["a b \U0010ffff"]).ids
    assert int(ids.min()) >= 3
    assert int(ids.max()) < tokenizer.vocab_size


@pytest.fixture
def definition():
    pieces = [
        "<unk>",
        "<s>",
        "</s>",
        "In",
        ":",
        "What",
        "action",
        "should",
        "the",
        "robot",
        "take",
        "to",
        "?",
    ]
    pieces += ["Out", "\n", "lift", "cube", " "]
    tokenizer = Tokenizer(models.WordLevel({piece: i for i, piece in enumerate(pieces)}, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Split(" ", "removed")
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(" ", "removed"),
            pre_tokenizers.Punctuation(),
            pre_tokenizers.Split("\n", "isolated"),
        ]
    )
    return tokenizer.to_str()


def test_a_tokenizer_file_is_data(definition, tmp_path):
    (tmp_path / "tokenizer.json").write_text(definition)
    tokenizer = LlamaTokenizer.from_file(tmp_path / "tokenizer.json")
    prompts = tokenizer.encode(["lift the CUBE"])
    # In : What action should the robot take to | lift the cube | ? \n Out : and Llama's empty word
    assert prompts.ids[0].tolist() == [3, 4, 5, 6, 7, 8, 9, 10, 11, 15, 8, 16, 12, 14, 13, 4, 29871]
    assert prompts.task[0].nonzero().flatten().tolist() == [9, 10, 11]
    assert tokenizer.vocab_size == 29872


def test_padding_and_cuts_that_a_file_asks_for_are_not_made(definition):
    fields = json.loads(definition)
    padding = {"strategy": {"Fixed": 10**12}, "direction": "Right", "pad_to_multiple_of": None}
    fields["padding"] = padding | {"pad_id": 0, "pad_type_id": 0, "pad_token": "<unk>"}
    fields["truncation"] = {"max_length": 1, "strategy": "LongestFirst", "stride": 0, "direction": "Right"}
    expected = LlamaTokenizer(definition).encode(["lift the cube"])
    assert torch.equal(LlamaTokenizer(json.dumps(fields)).encode(["lift the cube"]).ids, expected.ids)


def test_the_highest_id_of_a_vocabulary_counts(definition):
    fields = json.loads(definition)
    fields["model"]["vocab"]["cube"] = 99_999
    assert LlamaTokenizer(json.dumps(fields)).vocab_size == 100_000


@pytest.mark.parametrize("make", [lambda _: WordTokenizer(["lift"]), LlamaTokenizer])
def test_config_round_trip(make, definition):
    tokenizer = make(definition)
    again = tokenizer_from_config(json.loads(json.dumps(tokenizer.to_config())))
    assert torch.equal(again.encode(["lift it"]).ids, tokenizer.encode(["lift it"]).ids)


def test_damaged_files_are_named(definition, tmp_path):
    with refused("tokenizer", FileNotFoundError):
        LlamaTokenizer.from_file(tmp_path / "tokenizer.json")
    (tmp_path / "tokenizer.json").write_text("{}")
    with refused("tokenizer.json"):
        LlamaTokenizer.from_file(tmp_path / "tokenizer.json")
    charsmap = {"normalizer": {"type": "Precompiled", "precompiled_charsmap": ""}}
    (tmp_path / "tokenizer.json").write_text(json.dumps(json.loads(definition) | charsmap))
    with refused("tokenizer.json"):
        LlamaTokenizer.from_file(tmp_path / "tokenizer.json")
