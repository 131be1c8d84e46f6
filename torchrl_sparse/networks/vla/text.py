"""Tokenizers of instructions, in the published prompt ``In: What action should the robot take to {instruction}?\\nOut:``."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError

__all__ = ["BOS_ID", "STOP_ID", "InstructionTokenizer", "LlamaTokenizer", "Prompts", "WordTokenizer"]

BOS_ID, STOP_ID = 1, 2
_EMPTY_WORD_ID = 29871
"""Of Llama's vocabulary; ends every prompt that OpenVLA was trained on."""
_BEFORE, _AFTER = "In: What action should the robot take to ", "?\nOut:"
_PIECE = re.compile(r"\w+|[^\w\s]|\s")


@dataclass
class Prompts:
    """Tokenised prompts of a batch, without BOS, padded at their ends.

    Attributes:
        ids: i64 [B, P].
        mask: bool [B, P], False on padding.
        task: bool [B, P], the instruction's own words.
    """

    ids: Tensor
    mask: Tensor
    task: Tensor

    def to(self, device: torch.device) -> Prompts:
        """Return the same prompts on ``device``."""
        return Prompts(self.ids.to(device), self.mask.to(device), self.task.to(device))


class InstructionTokenizer(Protocol):
    """Tokenizer from instructions to prompts. ``vocab_size`` is the number of ids that it may use."""

    vocab_size: int

    def encode(self, instructions: Sequence[str]) -> Prompts:
        """Return the prompts of a batch of instructions."""

    def to_config(self) -> dict[str, Any]:
        """Return JSON values for `tokenizer_from_config`."""


class WordTokenizer:
    """Small tokenizer: one id per known word, bytes for any other word; spaces between words are not encoded.

    Args:
        words: the known words; those of the prompt are known anyway.

    Examples:
        >>> tokenizer = WordTokenizer(["lift", "cube"])
        >>> prompts = tokenizer.encode(["Lift cube", "lift"])
        >>> prompts.task.sum(1).tolist(), tokenizer.vocab_size
        ([2, 1], 270)
    """

    def __init__(self, words: Sequence[str]):
        own = [piece for piece in _pieces(_BEFORE + _AFTER) if len(piece) > 1]
        self.words = sorted({*map(str.lower, words)} - {*own})
        self._ids = {word: 3 + 256 + i for i, word in enumerate([*own, *self.words])}
        self.vocab_size = 3 + 256 + len(self._ids)

    def encode(self, instructions: Sequence[str]) -> Prompts:
        """Return the prompts of ``instructions``, in lower case."""
        before, after = self._encode(_BEFORE), self._encode(_AFTER)
        rows = [self._encode(text) for text in instructions]
        return _pad([before + ids + after for ids in rows], [(len(before), len(ids)) for ids in rows])

    def _encode(self, text: str) -> list[int]:
        ids = []
        for piece in _pieces(text):
            known = self._ids.get(piece)
            ids += [3 + byte for byte in piece.encode()] if known is None else [known]
        return ids

    def to_config(self) -> dict[str, Any]:
        """Return JSON values for `tokenizer_from_config`."""
        return {"kind": "words", "words": self.words}


class LlamaTokenizer:
    """Tokenizer of a language model, by default the published one, from the text of its ``tokenizer.json``: data only.

    Args:
        definition: the text.
        closing: id of the token that ends every prompt; None for none.

    Raises:
        InputError: if the text is no tokenizer.
    """

    def __init__(self, definition: str, closing: int | None = _EMPTY_WORD_ID):
        from tokenizers import Tokenizer

        try:
            self._tokenizer = Tokenizer.from_str(definition)
        except (KeyboardInterrupt, SystemExit):
            raise
        except (
            BaseException
        ) as error:  # the Rust library raises plain Exceptions, and panics that are not even those
            raise InputError(f"expected the text of a tokenizer.json, got: {error}") from error
        # Prompts are padded here; what a file asks for could be any length.
        self._tokenizer.no_padding()
        self._tokenizer.no_truncation()
        self.definition, self.closing = definition, closing
        highest = max(self._tokenizer.get_vocab().values(), default=0)
        self.vocab_size = 1 + max(highest, closing or 0)

    @classmethod
    def from_file(cls, path: str | Path) -> LlamaTokenizer:
        """Load the tokenizer in the file ``path``.

        Raises:
            FileNotFoundError, InputError: naming the file.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"tokenizer: expected a file {path}")
        try:
            return cls(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error

    def encode(self, instructions: Sequence[str]) -> Prompts:
        """Return the prompts of ``instructions``, in lower case, as OpenVLA was trained on them."""
        rows, spans = [], []
        for text in instructions:
            encoding = self._tokenizer.encode(f"{_BEFORE}{text.lower()}{_AFTER}", add_special_tokens=False)
            start, stop = len(_BEFORE), len(_BEFORE) + len(text)
            # a token belongs to the instruction if its last character does: it may begin with the space before
            inside = [start < end <= stop for _, end in encoding.offsets]
            if self.closing is None or encoding.ids[-1] == self.closing:
                rows.append(encoding.ids)
            else:
                rows.append([*encoding.ids, self.closing])
            spans.append((inside.index(True) if any(inside) else 0, sum(inside)))
        return _pad(rows, spans)

    def to_config(self) -> dict[str, Any]:
        """Return JSON values for `tokenizer_from_config`."""
        config = {"kind": "llama", "definition": json.loads(self.definition)}
        return config if self.closing == _EMPTY_WORD_ID else {**config, "closing": self.closing}


def tokenizer_from_config(config: Any) -> InstructionTokenizer:
    """Make a tokenizer from the ``config`` of its ``to_config``.

    Raises:
        InputError: if it is none.
    """
    match config:
        case {"kind": "words", "words": list(words), **rest} if not rest and _are_words(words):
            return WordTokenizer(words)
        case {"kind": "llama", "definition": dict(definition), **rest} if not rest:
            return LlamaTokenizer(json.dumps(definition))
        case {"kind": "llama", "definition": dict(definition), "closing": None, **rest} if not rest:
            return LlamaTokenizer(json.dumps(definition), closing=None)
    raise InputError(f"tokenizer: expected kind 'words' or 'llama' and its field, got {str(config)[:80]}")


def _are_words(values: list[Any]) -> bool:
    return all(isinstance(value, str) for value in values)


def _pieces(text: str) -> list[str]:
    return [piece for piece in _PIECE.findall(text.lower()) if piece != " "]


def _pad(rows: list[list[int]], spans: list[tuple[int, int]]) -> Prompts:
    """Pad rows of ids to prompts; ``spans`` are start and length of the instruction in each."""
    lengths = torch.tensor([len(row) for row in rows])
    place = torch.arange(int(lengths.max()))
    ids = torch.tensor([row + [0] * (len(place) - len(row)) for row in rows])
    start, count = (torch.tensor(column)[:, None] for column in zip(*spans, strict=True))
    return Prompts(ids, place < lengths[:, None], (start <= place) & (place < start + count))
