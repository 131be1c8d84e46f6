"""CLIP's towers (arXiv:2103.00020) as encoders of cameras and instructions, as LeRobot's ``multi_task_dit`` uses them.

Parameter names equal those of CLIP's files, so that weights need no translation, and nothing beside PyTorch is needed. An
image is encoded as its class token before the last norm, an instruction as its end token behind the text tower and a linear
layer. Attention among words is causal: what follows the end token cannot change it, so that padding is not computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.sizes import check_size

__all__ = ["ClipText", "ClipVision", "tower_sizes"]

_MAX_WIDTH, _MAX_LAYERS, _MAX_TOKENS, _MAX_WORDS = 1 << 14, 128, 1 << 14, 1 << 20
_OLD_END = 2
"""End token that CLIP's first configurations name; their end token is the largest id instead."""


def _quick_gelu(x: Tensor) -> Tensor:
    return x * torch.sigmoid(1.702 * x)


ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"quick_gelu": _quick_gelu, "gelu": functional.gelu}


def tower_sizes(**sizes: Any) -> dict[str, Any]:
    """Check and return the sizes of a tower: ``width``, ``heads``, ``layers``, ``inner``, ``act`` and ``eps``.

    Raises:
        InputError: if one is no positive number or far too large, or ``act`` is not known.
    """
    for name in ("width", "heads", "inner"):
        check_size(name, sizes[name], _MAX_WIDTH)
    check_size("layers", sizes["layers"], _MAX_LAYERS)
    if sizes["width"] % sizes["heads"]:
        raise InputError(f"width: expected a multiple of heads={sizes['heads']}, got {sizes['width']}")
    if sizes["act"] not in ACTIVATIONS:
        raise InputError(f"act: expected one of {', '.join(ACTIVATIONS)}, got {sizes['act']!r}")
    return sizes


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.q_proj, self.k_proj, self.v_proj, self.out_proj = (nn.Linear(width, width) for _ in range(4))

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        query, key, value = (
            project(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for project in (self.q_proj, self.k_proj, self.v_proj)
        )
        mixed = functional.scaled_dot_product_attention(query, key, value, is_causal=causal)
        return self.out_proj(mixed.transpose(1, 2).flatten(2))


class _Layer(nn.Module):
    def __init__(self, sizes: dict[str, Any]) -> None:
        super().__init__()
        width, inner = sizes["width"], sizes["inner"]
        self.layer_norm1 = nn.LayerNorm(width, eps=sizes["eps"])
        self.self_attn = _Attention(width, sizes["heads"])
        self.layer_norm2 = nn.LayerNorm(width, eps=sizes["eps"])
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(width, inner), "fc2": nn.Linear(inner, width)})
        self.act = sizes["act"]

    def forward(self, x: Tensor, causal: bool) -> Tensor:
        x = x + self.self_attn(self.layer_norm1(x), causal)
        hidden = ACTIVATIONS[self.act](self.mlp["fc1"](self.layer_norm2(x)))
        return x + self.mlp["fc2"](hidden)


class _Layers(nn.Module):
    def __init__(self, sizes: dict[str, Any]) -> None:
        super().__init__()
        self.layers = nn.ModuleList([_Layer(sizes) for _ in range(sizes["layers"])])

    def forward(self, x: Tensor, causal: bool = False) -> Tensor:
        for layer in self.layers:
            x = layer(x, causal)
        return x


class _ImageEmbeddings(nn.Module):
    def __init__(self, width: int, size: int, patch: int) -> None:
        super().__init__()
        self.class_embedding = nn.Parameter(torch.zeros(width))
        self.patch_embedding = nn.Conv2d(3, width, patch, stride=patch, bias=False)
        self.position_embedding = nn.Embedding((size // patch) ** 2 + 1, width)

    def forward(self, pixels: Tensor) -> Tensor:
        patches = self.patch_embedding(pixels).flatten(2).transpose(1, 2)
        first = self.class_embedding.expand(len(pixels), 1, -1)
        return torch.cat([first, patches], dim=1) + self.position_embedding.weight


class ClipVision(nn.Module):
    """Features [N, width] of normalised images [N, 3, size, size]: the class token of the last layer.

    Args:
        size, patch: pixels of an image's side and of a patch's, which divides it.
        sizes: see `tower_sizes`.
    """

    def __init__(self, *, size: int, patch: int, **sizes: Any) -> None:
        super().__init__()
        check_size("size", size, _MAX_TOKENS)
        check_size("patch", patch, size)
        if size % patch:
            raise InputError(f"size: expected a multiple of patch={patch}, got {size}")
        tower = tower_sizes(**sizes)
        self.size = size
        self.embeddings = _ImageEmbeddings(tower["width"], size, patch)
        self.pre_layrnorm = nn.LayerNorm(tower["width"], eps=tower["eps"])  # the published name
        self.encoder = _Layers(tower)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.encoder(self.pre_layrnorm(self.embeddings(pixels)))[:, 0]


class ClipText(nn.Module):
    """Features [width] of an instruction's token ids: its end token behind the last norm.

    Args:
        words, tokens: sizes of the vocabulary, and of the longest instruction.
        end: id of the end token.
        sizes: see `tower_sizes`.
    """

    def __init__(self, *, words: int, tokens: int, end: int, **sizes: Any) -> None:
        super().__init__()
        check_size("words", words, _MAX_WORDS)
        check_size("tokens", tokens, _MAX_TOKENS)
        tower = tower_sizes(**sizes)
        self.words, self.tokens, self.end = words, tokens, end
        self.embeddings = nn.ModuleDict(
            {
                "token_embedding": nn.Embedding(words, tower["width"]),
                "position_embedding": nn.Embedding(tokens, tower["width"]),
            }
        )
        self.encoder = _Layers(tower)
        self.final_layer_norm = nn.LayerNorm(tower["width"], eps=tower["eps"])

    def forward(self, ids: Sequence[int]) -> Tensor:
        """Encode one instruction.

        Raises:
            InputError: if an id is none of the vocabulary, or there are none or too many.
        """
        if not 1 <= len(ids) <= self.tokens or not all(0 <= number < self.words for number in ids):
            raise InputError(
                f"tokens: expected 1 to {self.tokens} ids from 0 to {self.words - 1}, got {list(ids)}"
            )
        last = self._last(list(ids))
        used = torch.tensor(ids[: last + 1], device=self.final_layer_norm.weight.device)
        x = (
            self.embeddings["token_embedding"](used)
            + self.embeddings["position_embedding"].weight[: last + 1]
        )
        return self.final_layer_norm(self.encoder(x[None], causal=True)[0, -1])

    def _last(self, ids: list[int]) -> int:
        """Return the place of the token that stands for all, as CLIP's code finds it."""
        if self.end == _OLD_END:
            return ids.index(max(ids))
        return ids.index(self.end) if self.end in ids else 0
