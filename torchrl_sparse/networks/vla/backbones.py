"""The parts of `transformers` that vision-language-action policies are made of; everything else works without it."""

try:
    from transformers import (
        Dinov2WithRegistersConfig,
        Dinov2WithRegistersModel,
        LlamaConfig,
        LlamaModel,
        SiglipVisionConfig,
        SiglipVisionModel,
    )
    from transformers.models.llama.modeling_llama import LlamaDecoderLayer, apply_rotary_pos_emb
except ImportError as error:
    raise ImportError(
        f"vision-language-action policies need the extra vla, pip install 'torchrl-sparse[vla]': {error}"
    ) from error

__all__ = [
    "Dinov2WithRegistersConfig",
    "Dinov2WithRegistersModel",
    "LlamaConfig",
    "LlamaDecoderLayer",
    "LlamaModel",
    "SiglipVisionConfig",
    "SiglipVisionModel",
    "apply_rotary_pos_emb",
]
