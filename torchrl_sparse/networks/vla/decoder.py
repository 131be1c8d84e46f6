"""A Llama decoder with bidirectional attention that can drop visual tokens before and between its layers.

OpenVLA-OFT (arXiv:2502.19645) predicts all actions in one pass and therefore attends to every token in both directions. Stock
Llama attends causally; here nothing is masked but padding. Attention is always PyTorch's fused kernel; where `LayerHooks` ask
for scores, the few rows they name are multiplied with the keys once more beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.networks.vla import backbones
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.hooks import LayerHooks, LayerState

__all__ = [
    "BidirectionalLlama",
    "Decoded",
    "Ran",
    "Rotary",
    "RunLayers",
    "pack",
    "row_attention",
    "visual_scores",
]

_PER_TOKEN = ("hidden", "positions", "kind", "task")
Rotary = tuple[Tensor, Tensor]


class Ran(NamedTuple):
    """What a stretch of layers leaves; all but ``hidden`` mean something only where its last layer is scored.

    Attributes:
        hidden: [B, S, d], its output.
        before: [B, S, d], the input of its last layer.
        query, key: [B, heads, S, head_dim], of its last layer.
    """

    hidden: Tensor
    before: Tensor
    query: Tensor
    key: Tensor


RunLayers = Callable[[Sequence[int], Tensor, Rotary, "Tensor | None", bool], Ran]


@dataclass
class Decoded:
    """The decoder's output, and the number of tokens in each layer.

    Attributes:
        hidden: [B, S, d] after the final norm; a row's alive tokens are its first ones.
        lengths: i64 [B], alive tokens of each row.
        tokens: i64 [B, L], tokens on which each layer ran; 0 where it was skipped.
        depth: i64 [B, N], layers that ran on each visual token.
        scored: i64 [B], policy call-key pairs of all scores, rows times tokens.
        visual: [B, N, d], the visual tokens that the decoder was given; None where the network does not add them.
    """

    hidden: Tensor
    lengths: Tensor
    tokens: Tensor
    depth: Tensor
    scored: Tensor
    visual: Tensor | None = None


class BidirectionalLlama(nn.Module):
    """Llama's layers, run on embeddings without a causal mask; see the module."""

    def __init__(self, config: VLAConfig):
        super().__init__()
        self.llama = backbones.LlamaModel(
            backbones.LlamaConfig(
                vocab_size=config.vocab_size,
                hidden_size=config.llm.dim,
                intermediate_size=config.llm.mlp,
                num_hidden_layers=config.llm.layers,
                num_attention_heads=config.llm.heads,
                num_key_value_heads=config.kv_heads,
                rms_norm_eps=config.norm_eps,
                # Llama's constant 0.02 is made for wide models; a narrow one hardly learns to read with it
                initializer_range=config.llm.dim**-0.5,
            )
        )
        self.llama.rotary_emb = nn.Identity()  # angles are computed here
        self.head_dim = config.llm.dim // config.llm.heads
        self._rope_base = config.rope_base

    def embed(self, ids: Tensor) -> Tensor:
        """Return the embeddings [..., d] of token ids i64 [...]."""
        return self.llama.embed_tokens(ids)

    def forward(
        self, state: LayerState, hooks: LayerHooks | None = None, run: RunLayers | None = None
    ) -> Decoded:
        """Run all layers on ``state.hidden``, without the tokens that ``state.alive`` excludes.

        Args:
            state: the whole sequence.
            hooks: called around layers; None is dense.
            run: what runs the layers between two calls of ``hooks``; by default `run_layers`.
        """
        hooks, run = LayerHooks() if hooks is None else hooks, self.run_layers if run is None else run
        num_layers = len(self.llama.layers)
        scored_layers, skipped = hooks.layers_scored(num_layers), hooks.layers_skipped(num_layers)
        state, mask = pack(state, state.alive)
        hooks.before_layers(state)
        table = self._angles(int(state.positions.max()) + 1, state.hidden)
        rotary, lengths, seen = _at(table, state.positions), state.alive.sum(1), state.visual_alive
        depth, scored = torch.zeros_like(seen, dtype=torch.int64), torch.zeros_like(lengths)
        tokens = lengths.new_zeros(num_layers, len(lengths))
        for layers in _stretches(num_layers, skipped, scored_layers | hooks.layers_watched(num_layers)):
            tokens[list(layers)] = lengths
            depth = depth + seen * len(layers)
            index, is_scored = layers[-1], layers[-1] in scored_layers
            ran = run(layers, state.hidden, rotary, mask, is_scored)
            state = replace(state, layer=index, hidden=ran.before, scores=None, attention=None)
            if is_scored:
                rows = hooks.score_rows(state)
                state.attention, state.scores = visual_scores(state, ran.query, ran.key, rows)
                scored = scored + rows.sum(1) * lengths
            state.hidden = ran.hidden
            keep = hooks.after_layer(index, state)
            if keep is not None:
                state, mask = pack(state, state.alive & (keep | ~state.is_visual))
                rotary, lengths = _at(table, state.positions), state.alive.sum(1)
                seen = state.visual_alive
        return Decoded(self.llama.norm(state.hidden), lengths, tokens.T, depth, scored)

    def run_layers(
        self, layers: Sequence[int], hidden: Tensor, rotary: Rotary, mask: Tensor | None, scored: bool
    ) -> Ran:
        """Run some layers one after the other; nothing reads or prunes what lies between them.

        Args:
            layers: their indices, at least one.
            hidden: [B, S, d], input of the first.
            rotary: cosine and sine, [B, S, head_dim] each.
            mask: bool [B, 1, 1, S], what attention may see; None is everything.
            scored: whether queries, keys and the input of the last layer are wanted.
        """
        return run_stretch(
            [self.llama.layers[index] for index in layers], hidden, rotary, mask, self.head_dim
        )

    def _angles(self, count: int, like: Tensor) -> Rotary:
        """Return cosine and sine, [count, head_dim] each, of all positions (arXiv:2104.09864), computed in f32."""
        exponent = torch.arange(0, self.head_dim, 2, device=like.device, dtype=torch.float32)
        positions = torch.arange(count, device=like.device)
        angle = positions[:, None].float() * self._rope_base ** (-exponent / self.head_dim)
        angle = torch.cat([angle, angle], dim=-1)
        return angle.cos().to(like.dtype), angle.sin().to(like.dtype)


def _at(table: Rotary, positions: Tensor) -> Rotary:
    """Return cosine and sine, [B, S, head_dim] each, of the original positions."""
    cos, sin = table
    return cos[positions], sin[positions]


def _stretches(num_layers: int, skipped: Set[int], ends: Set[int]) -> Iterator[tuple[int, ...]]:
    """Cut the layers that run behind each of ``ends``."""
    stretch: list[int] = []
    for index in range(num_layers):
        if index not in skipped:
            stretch.append(index)
            if index in ends:
                yield tuple(stretch)
                stretch = []
    if stretch:
        yield tuple(stretch)


def pack(state: LayerState, alive: Tensor) -> tuple[LayerState, Tensor | None]:
    """Move the ``alive`` tokens, bool [B, S], to the front of each row, in order, and truncate to the longest row.

    Returns:
        The shorter sequence, and what its attention may see: bool [B, 1, 1, S'], or None for everything. A sequence that is
        packed already comes back with the very same values.
    """
    lengths = alive.sum(1)
    front = torch.arange(alive.shape[1], device=alive.device) < lengths[:, None]
    # one copy to the host for all three numbers
    longest, shortest, packed = torch.stack(
        [lengths.max(), lengths.min(), (front == alive).all().long()]
    ).tolist()
    batch = torch.arange(len(alive), device=alive.device)[:, None]
    order = None if packed else (~alive).int().argsort(dim=1, stable=True)[:, :longest]
    values = {name: getattr(state, name) for name in _PER_TOKEN}
    moved = {name: v[:, :longest] if packed else v[batch, order] for name, v in values.items()}
    state = replace(state, alive=front[:, :longest], **moved)
    return state, None if shortest == longest else state.alive[:, None, None]


def row_attention(query: Tensor, key: Tensor, rows: Tensor, alive: Tensor) -> Tensor:
    """Return the attention of selected rows to all tokens, mean over heads: f32 [B, R, S], R the most rows of a sample.

    Args:
        query, key: [B, heads, S, head_dim].
        rows: bool [B, S]; a sample's rows come in order, those that it lacks to R are 0.
        alive: bool [B, S]; other tokens get no attention.

    Examples:
        >>> query, key = torch.randn(2, 1, 2, 5, 4).unbind()
        >>> rows = torch.tensor([[True, True, False, False, False]])
        >>> row_attention(query, key, rows, torch.ones_like(rows)).sum(-1).allclose(torch.ones(1, 2))
        True
    """
    single = len(rows) == 1  # has nothing to be padded to
    if single:
        index = rows.nonzero()[:, 1][None]
    else:
        counts = rows.sum(1)
        longest = int(counts.max())
        index = (~rows).int().argsort(dim=1, stable=True)[:, :longest]
    picked = query.gather(2, index[:, None, :, None].expand(-1, query.shape[1], -1, query.shape[3]))
    logits = picked @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
    logits = logits.float().masked_fill(~alive[:, None, None], -torch.inf)
    if single:
        return logits.softmax(-1).mean(1)
    real = torch.arange(longest, device=rows.device) < counts[:, None]
    return logits.softmax(-1).mean(1) * real[..., None]


@torch.no_grad()
def visual_scores(state: LayerState, query: Tensor, key: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``attention`` [B, R, N] and ``scores`` [B, N] of `LayerState`: Eq. 1 of SpecPrune-VLA (arXiv:2509.05614).

    Args:
        query, key: [B, heads, S, head_dim].
        rows: bool [B, S], the tokens whose attention it is.
    """
    rows = rows & state.alive
    weights = row_attention(query, key, rows, state.alive)
    ids = torch.where(state.is_visual, state.visual_ids, state.num_visual)
    attention = weights.new_zeros(*weights.shape[:2], state.num_visual + 1)
    attention = attention.scatter(2, ids[:, None].expand_as(weights), weights)[..., :-1]
    return attention, attention.sum(1) / rows.sum(1, keepdim=True).clamp(min=1)


def run_stretch(
    layers: Iterable[nn.Module], hidden: Tensor, rotary: Rotary, mask: Tensor | None, head_dim: int
) -> Ran:
    """Run some of Llama's layers, see `BidirectionalLlama.run_layers`."""
    for layer in layers:
        before = hidden
        hidden, query, key = _run_layer(layer, before, rotary, mask, head_dim)
    return Ran(hidden, before, query, key)


def _run_layer(
    layer: nn.Module,
    hidden: Tensor,
    rotary: tuple[Tensor, Tensor],
    mask: Tensor | None,
    head_dim: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Run one of Llama's layers; return its output, and its queries and keys, [B, heads, S, head_dim].

    Heads that share keys and values get them once each, so that whoever reads attention knows nothing of groups.
    """
    attention = layer.self_attn
    normed = layer.input_layernorm(hidden)
    query, key, value = (
        project(normed).unflatten(-1, (-1, head_dim)).transpose(1, 2)
        for project in (attention.q_proj, attention.k_proj, attention.v_proj)
    )
    query, key = backbones.apply_rotary_pos_emb(query, key, *rotary)
    if (groups := query.shape[1] // key.shape[1]) > 1:
        key, value = (shared.repeat_interleave(groups, dim=1) for shared in (key, value))
    attended = _attend(query, key, value, mask)
    hidden = hidden + attention.o_proj(attended.transpose(1, 2).flatten(2))
    return hidden + layer.mlp(layer.post_attention_layernorm(hidden)), query, key


def _attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None) -> Tensor:
    """Return the attention of queries [B, heads, S, head_dim] to keys, ``mask`` bool [B, 1, 1, S] what they may see.

    Where a CPU trains in bf16, three plain operations and their gradient took 0.4 of the time of PyTorch's own (175 tokens,
    an Intel Xeon with AMX).
    """
    trains = torch.is_grad_enabled() and torch.is_autocast_enabled("cpu")
    if not (trains and query.device.type == "cpu"):
        return functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
    query, key, value = (each.to(torch.get_autocast_dtype("cpu")) for each in (query, key, value))
    logits = torch.matmul(query * query.shape[-1] ** -0.5, key.transpose(-1, -2))
    if mask is not None:
        logits = logits.masked_fill(~mask, -torch.inf)
    return torch.matmul(logits.softmax(-1), value)
