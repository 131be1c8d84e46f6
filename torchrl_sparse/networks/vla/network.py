"""The network of OpenVLA-OFT (arXiv:2502.19645): images, state and prompt to a normalised action chunk, in one pass.

Sequence: ``BOS | primary patches | wrist patches | proprio | prompt | action slots | stop``. The embedding of a slot is zero,
only its position tells it from the others. As in next-token prediction, a slot is read out from the token *before* it: the
last prompt token and all slots but the last.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.decoder import BidirectionalLlama, Decoded, Ran, Rotary
from torchrl_sparse.networks.vla.heads import L1ActionHead, ProprioProjector
from torchrl_sparse.networks.vla.hooks import LayerHooks, LayerState, TokenKind
from torchrl_sparse.networks.vla.text import BOS_ID, STOP_ID, Prompts
from torchrl_sparse.networks.vla.vision import FusedProjector, VisionTowers

__all__ = ["VLAEngine", "VLANetwork", "make_network", "network_of"]


class VLAEngine(Protocol):
    """Computes the parts of a `VLANetwork` that cost time, as the network itself does, up to rounding.

    Methods are those of the network; what they return is the caller's.
    """

    def visual_tokens(self, images: Tensor) -> Tensor: ...

    def run_layers(
        self, layers: Sequence[int], hidden: Tensor, rotary: Rotary, mask: Tensor | None, scored: bool
    ) -> Ran: ...

    def read_actions(self, readout: Tensor) -> Tensor: ...


class VLANetwork(nn.Module):
    """Network from images, state and prompts to a chunk of normalised actions.

    Args:
        config: its sizes.

    Examples:
        >>> from torchrl_sparse.networks.vla.text import WordTokenizer
        >>> network = VLANetwork(VLAConfig.tiny())
        >>> prompts = WordTokenizer(["lift", "the", "cube"]).encode(["lift the cube", "lift"])
        >>> images = torch.zeros(2, 2, 3, 28, 28, dtype=torch.uint8)
        >>> actions, decoded = network(images, torch.zeros(2, 8), prompts)
        >>> actions.shape, decoded.tokens.shape
        (torch.Size([2, 2, 7]), torch.Size([2, 4]))
    """

    def __init__(self, config: VLAConfig):
        super().__init__()
        self.config = config
        self.vision = VisionTowers(config)
        self.projector = FusedProjector(config)
        self.proprio = ProprioProjector(config)
        self.decoder = BidirectionalLlama(config)
        self.head = L1ActionHead(config)

    def forward(
        self,
        images: Tensor,
        state: Tensor,
        prompts: Prompts,
        *,
        keep_mask: Tensor | None = None,
        hooks: LayerHooks | None = None,
        td: TensorDictBase | None = None,
        engine: VLAEngine | None = None,
    ) -> tuple[Tensor, Decoded]:
        """Return actions [B, H, A], f32, and the decoder's output.

        Args:
            images: u8 [B, cameras, 3, h, w], cropped where the model was trained so.
            state: f32 [B, state_dim], normalised.
            prompts: tokenised prompts of the B samples.
            keep_mask: bool [B, N], the visual tokens that enter the decoder; all by default.
            hooks: called around each layer of the decoder; None is dense.
            td: the policy call that ``hooks`` are shown, [B].
            engine: what computes the network's parts; by default this module.
        """
        engine = self if engine is None else engine
        td = TensorDict({}, [len(images)], device=images.device) if td is None else td
        visual = engine.visual_tokens(images)
        sequence = self._sequence(visual, state, prompts, keep_mask, td)
        decoded = replace(self.decoder(sequence, hooks, engine.run_layers), visual=visual)
        return engine.read_actions(self.readout(decoded)).float(), decoded

    def visual_tokens(self, images: Tensor) -> Tensor:
        """Return the visual tokens [B, N, d] of images u8 [B, cameras, 3, h, w], camera by camera."""
        return self.projector(self.vision(images.flatten(0, 1))).unflatten(0, images.shape[:2]).flatten(1, 2)

    def run_layers(
        self, layers: Sequence[int], hidden: Tensor, rotary: Rotary, mask: Tensor | None, scored: bool
    ) -> Ran:
        """Run a stretch of the decoder's layers, see `BidirectionalLlama.run_layers`."""
        return self.decoder.run_layers(layers, hidden, rotary, mask, scored)

    def read_actions(self, readout: Tensor) -> Tensor:
        """Return the actions [B, H, A] for decoder outputs [B, H * A, d]."""
        return self.head(readout)

    def _sequence(
        self, visual: Tensor, state: Tensor, prompts: Prompts, keep_mask: Tensor | None, td: TensorDictBase
    ) -> LayerState:
        """Lay out the decoder's input; tokens that are pruned already or pad a prompt are in it, but not alive."""
        batch, num_visual, width = visual.shape
        slots, text, device = self.config.num_slots, prompts.mask, visual.device
        ends = self.decoder.embed(torch.tensor([BOS_ID, STOP_ID], device=device)).expand(batch, 2, width)
        proprio = self.proprio(state.to(visual.dtype))[:, None]
        words = self.decoder.embed(prompts.ids)
        blank = visual.new_zeros(batch, slots, width)
        hidden = torch.cat([ends[:, :1], visual, proprio, words, blank, ends[:, 1:]], dim=1)

        def ones(count: int) -> Tensor:
            return text.new_ones(batch, count)

        keep = ones(num_visual) if keep_mask is None else keep_mask
        alive = torch.cat([ones(1), keep, ones(1), text, ones(slots + 1)], dim=1)
        front = torch.arange(num_visual + 2 + text.shape[1], device=device).expand(batch, -1)
        after_text = num_visual + 2 + text.sum(1, keepdim=True)
        back = after_text + torch.arange(slots + 1, device=device)
        positions = torch.cat([front, back], dim=1)
        task = torch.cat([~ones(num_visual + 2), prompts.task, ~ones(slots + 1)], dim=1)
        kind = self._kinds(text.shape[1], device).expand(batch, -1)
        return LayerState(0, hidden, alive, positions, kind, task, num_visual, td)

    def _kinds(self, text: int, device: torch.device) -> Tensor:
        """Return the `TokenKind`, i64 [S], of a sequence with ``text`` prompt tokens."""
        views = list(zip((TokenKind.PRIMARY, TokenKind.WRIST), self.config.visual_spec.views, strict=False))
        counts = [(TokenKind.BOS, 1), *((kind, view.stop - view.start) for kind, view in views)]
        counts += [(TokenKind.PROPRIO, 1), (TokenKind.TEXT, text)]
        counts += [(TokenKind.ACTION, self.config.num_slots), (TokenKind.STOP, 1)]
        kinds, repeats = (torch.tensor(column, device=device) for column in zip(*counts, strict=True))
        return kinds.repeat_interleave(repeats)

    def readout(self, decoded: Decoded) -> Tensor:
        """Return the hidden states from which actions are regressed, [B, H * A, d].

        A row ends with last prompt token, slots, stop; all of these but the last two are read.
        """
        slots = self.config.num_slots
        first = decoded.lengths[:, None] - slots - 2
        index = first + torch.arange(slots, device=first.device)
        return decoded.hidden.gather(1, index[..., None].expand(-1, -1, decoded.hidden.shape[-1]))


def make_network(
    config: VLAConfig, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> VLANetwork:
    """Make an untrained network with weights of ``dtype`` directly on ``device``, without a copy elsewhere.

    >>> make_network(VLAConfig.tiny(), dtype=torch.bfloat16).head.fc2.weight.dtype
    torch.bfloat16
    """
    with torch.device(device), _default_dtype(dtype):
        return VLANetwork(config)


def network_of(config: VLAConfig, weights: Mapping[str, Tensor]) -> VLANetwork:
    """Make a network in evaluation mode that uses these tensors as its weights, without initialising or copying any.

    Args:
        config: its sizes.
        weights: all of ``VLANetwork(config).state_dict()``.

    >>> weights = make_network(VLAConfig.tiny()).state_dict()
    >>> network_of(VLAConfig.tiny(), weights).head.fc2.bias.data_ptr() == weights["head.fc2.bias"].data_ptr()
    True
    """
    network = make_network(config, device="meta")
    network.load_state_dict(weights, assign=True)
    patches = network.vision.siglip.embeddings
    patches.position_ids = torch.arange(patches.num_patches)[None]  # the one tensor that is no weight
    return network.eval()


@contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
