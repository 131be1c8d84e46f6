"""Components from `transformers` for vision-language-action networks, each imported on first use.

So every module of this package imports without the extra ``vla``; making a network does not.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "Dinov2WithRegistersConfig": "transformers",
    "Dinov2WithRegistersModel": "transformers",
    "LlamaConfig": "transformers",
    "LlamaModel": "transformers",
    "SiglipVisionConfig": "transformers",
    "SiglipVisionModel": "transformers",
    "apply_rotary_pos_emb": "transformers.models.llama.modeling_llama",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        part = getattr(import_module(_HOME[name]), name)
    except ImportError as error:
        raise ImportError(
            f"vision-language-action policies need the extra vla, pip install 'torchrl-sparse[vla]': {error}"
        ) from error
    globals()[name] = part
    return part
