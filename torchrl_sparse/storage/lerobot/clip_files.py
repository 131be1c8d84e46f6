"""What of CLIP stands beside a policy: sizes that weights do not tell, and the tokenizer. Neither is code."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from torchrl_sparse.errors import InputError
from torchrl_sparse.storage.json import read_json
from torchrl_sparse.storage.lerobot.processors import TokenizerStep

__all__ = ["ClipFacts", "clip_facts", "find_tokenizer"]

_OPENAI = {  # heads of the vision and of the text tower
    "openai/clip-vit-base-patch16": (12, 8),
    "openai/clip-vit-base-patch32": (12, 8),
    "openai/clip-vit-large-patch14": (16, 12),
    "openai/clip-vit-large-patch14-336": (16, 12),
}


@dataclass(frozen=True)
class ClipFacts:
    """Of a tower: attention heads, activation, epsilon of norms, and of the text tower its end token."""

    heads: int
    act: str = "quick_gelu"
    eps: float = 1e-5
    end: int = 2


def clip_facts(folder: Path, entry: str, name: str, tower: str) -> ClipFacts:
    """Return what weights do not tell of a tower.

    Args:
        folder: of the policy.
        entry: of its configuration that holds the name.
        name: of a CLIP: a folder, from here or from the policy's folder or the one above, or one of OpenAI's.
        tower: ``"vision_config"`` or ``"text_config"``.

    Raises:
        InputError: naming the entry, if there is no such folder and the name is not OpenAI's.
    """
    file = _beside(folder, name, "config.json")
    if file is None:
        heads = _OPENAI.get(name.lower())
        if heads is None:
            raise InputError(
                f"{folder / 'config.json'}: {entry}: expected CLIP's folder, in the policy's or from here, with a config.json, "
                f"or one of {', '.join(_OPENAI)}, got {name!r}; copy the folder that the policy was trained with beside it"
            )
        return ClipFacts(heads[tower == "text_config"])
    found = read_json(file, dict[str, Any]).get(tower, {})
    heads = found.get("num_attention_heads", 12 if tower == "vision_config" else 8)
    act, eps = found.get("hidden_act", "quick_gelu"), found.get("layer_norm_eps", 1e-5)
    end = found.get("eos_token_id", 49407)
    whole = type(heads) is int and type(end) is int
    if not whole or not isinstance(act, str) or not isinstance(eps, float):
        raise InputError(
            f"{file}: {tower}: expected num_attention_heads, hidden_act, layer_norm_eps and eos_token_id as CLIP has them, "
            f"got {[heads, act, eps, end]}"
        )
    return ClipFacts(heads, act, eps, end)


def find_tokenizer(folder: Path, step: TokenizerStep, name: str) -> Callable[[str], list[int]] | None:
    """Return what makes token ids of a text, or None where no ``tokenizer.json`` lies beside the policy.

    Raises:
        InputError: naming the file, if it holds no tokenizer.
        ImportError: if the package that reads it is not installed.
    """
    file = folder / "tokenizer.json"
    found = file if file.is_file() else _beside(folder, step.tokenizer_name or name, "tokenizer.json")
    if found is None:
        return None
    try:
        from tokenizers import Tokenizer
    except ImportError as error:
        raise ImportError(f"{found}: reading it needs the package tokenizers: {error}") from error
    try:
        tokenizer = Tokenizer.from_file(str(found))
    except Exception as error:  # it raises no narrower one
        raise InputError(f"{found}: expected a tokenizer, got: {error}") from error
    tokenizer.no_padding()
    if step.truncation:
        tokenizer.enable_truncation(step.max_length)
    return partial(_encode, tokenizer)


def _encode(tokenizer: Any, text: str) -> list[int]:
    return tokenizer.encode(text).ids


def _beside(folder: Path, name: str, file: str) -> Path | None:
    places = [root / name / file for root in (folder, folder.parent, Path())]
    return next((place for place in places if place.is_file()), None)
