"""A Llama decoder with bidirectional attention that can drop visual tokens before and between its layers.

OpenVLA-OFT (arXiv:2502.19645) predicts all actions in one pass and therefore attends to every token in both directions. Stock
Llama attends causally; here nothing is masked but padding. Attention is always PyTorch's fused kernel; where `LayerHooks` ask
for scores, the few rows they name are multiplied with the keys once more beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sparse.networks.vla import backbones
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.hooks import LayerHooks, LayerState

__all__ = ["BidirectionalLlama", "Decoded", "pack", "row_attention", "visual_scores"]

_PER_TOKEN = ("hidden", "positions", "kind", "task")


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
        self._head_dim = config.llm.dim // config.llm.heads
        self._rope_base = config.rope_base

    def embed(self, ids: Tensor) -> Tensor:
        """Return the embeddings [..., d] of token ids i64 [...]."""
        return self.llama.embed_tokens(ids)

    def forward(self, state: LayerState, hooks: LayerHooks | None = None) -> Decoded:
        """Run all layers on ``state.hidden``, without the tokens that ``state.alive`` excludes.

        Args:
            state: the whole sequence.
            hooks: called around each layer; None is dense.
        """
        layers, hooks = self.llama.layers, LayerHooks() if hooks is None else hooks
        scored_layers, skipped = hooks.layers_scored(len(layers)), hooks.layers_skipped(len(layers))
        state, mask = pack(state, state.alive)
        hooks.before_layers(state)
        rotary, lengths, seen = self._rotary(state), state.alive.sum(1), state.visual_alive
        tokens, depth, scored = [], [], torch.zeros_like(lengths)
        for index, layer in enumerate(layers):
            if index in skipped:
                tokens.append(torch.zeros_like(lengths))
                continue
            tokens.append(lengths)
            depth.append(seen)
            state = replace(state, layer=index, scores=None, attention=None)
            rows = hooks.score_rows(state) if index in scored_layers else None
            state.hidden, query, key = _run_layer(layer, state.hidden, rotary, mask, self._head_dim)
            if rows is not None:
                state.attention, state.scores = visual_scores(state, query, key, rows)
                scored = scored + rows.sum(1) * lengths
            keep = hooks.after_layer(index, state)
            if keep is not None:
                state, mask = pack(state, state.alive & (keep | ~state.is_visual))
                rotary, lengths, seen = self._rotary(state), state.alive.sum(1), state.visual_alive
        depth = torch.stack(depth).sum(0) if depth else torch.zeros_like(seen, dtype=torch.int64)
        return Decoded(self.llama.norm(state.hidden), lengths, torch.stack(tokens, 1), depth, scored)

    def _rotary(self, state: LayerState) -> tuple[Tensor, Tensor]:
        """Return cosine and sine, [B, S, head_dim] each, of the original positions (arXiv:2104.09864), computed in f32."""
        exponent = torch.arange(0, self._head_dim, 2, device=state.hidden.device, dtype=torch.float32)
        angle = state.positions[..., None].float() * self._rope_base ** (-exponent / self._head_dim)
        angle = torch.cat([angle, angle], dim=-1)
        return angle.cos().to(state.hidden.dtype), angle.sin().to(state.hidden.dtype)


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
    counts = rows.sum(1)
    longest = int(counts.max())
    index = (~rows).int().argsort(dim=1, stable=True)[:, :longest]
    picked = query.gather(2, index[:, None, :, None].expand(-1, query.shape[1], -1, query.shape[3]))
    logits = picked @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
    logits = logits.float().masked_fill(~alive[:, None, None], -torch.inf)
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
