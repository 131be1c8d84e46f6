"""Cases of the latency benchmark of vision-language-action models: shapes, calls, parts, and pruning overhead.

Images are noise, and of `SHAPES` the weights too: they change which tokens go, not what arithmetic costs. Every method answers
the second call of an episode, in which a tenth of all patches has changed, with what it remembers of the first. Parts and
helpers are replayed on tensors of such a call, so that nothing is timed from within.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_sparse import keys
from torchrl_sparse.envs.tasks import TASKS, RobosuiteTask
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.decoder import pack, visual_scores
from torchrl_sparse.networks.vla.hooks import LayerState
from torchrl_sparse.networks.vla.network import make_network
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import WordTokenizer
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.frames import FRAME_KEYS, compare_frames

__all__ = ["SHAPES", "VLACase", "make_policy"]

SHAPES = {
    "openvla_oft": VLAConfig(crop_area=0.9),
    # The published tokens, and about the published share of the decoder, in a model that a CPU answers in seconds.
    "reduced": VLAConfig(
        dino=TransformerSize(256, 8, 4, 1024),
        siglip=TransformerSize(288, 9, 4, 1152),
        llm=TransformerSize(1024, 12, 16, 2816),
        crop_area=0.9,
    ),
    # SmolLM2-135M, with the towers of the small model and finer patches, and LiftNamed's state and actions.
    "smollm2": VLAConfig.small(
        llm=TransformerSize(576, 30, 9, 1536),
        vocab_size=49152,
        kv_heads=3,
        rope_base=1e5,
        norm_eps=1e-5,
        patch_size=7,
        state_dim=9,
        action_dim=10,
    ),
    "toy": VLAConfig.tiny(llm=TransformerSize(32, 8, 2, 64), image_size=112, crop_area=0.9),
}

# One of LIBERO's.
_INSTRUCTION = "pick up the black bowl between the plate and the ramekin and place it on the plate"
_CHANGED = 0.1


def make_policy(
    shape: str, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> VLAPolicy:
    """Make an untrained policy with one of `SHAPES`.

    Args:
        dtype, device: of the network's weights.

    Raises:
        InputError: on an unknown shape.
    """
    if shape not in SHAPES:
        raise InputError(f"shape: expected one of {', '.join(SHAPES)}, got {shape!r}")
    config = SHAPES[shape]
    torch.manual_seed(0)
    network = make_network(config, dtype=dtype, device=device).requires_grad_(False)
    normalizer = QuantileNormalizer.identity(config.state_dim, config.action_dim).to(device)
    return VLAPolicy(network, normalizer, WordTokenizer(_INSTRUCTION.split()))


class VLACase:
    """One network with several pruners on the same policy call, batch 1.

    Args:
        policy: whose network, normaliser and tokenizer all methods share.
        pruners: name -> pruner; None for dense.
        instruction: that the policy is given; None takes its task's first one, or one of LIBERO's.

    Attributes:
        policies: name -> its policy.
        queries: name -> the second call, with what the first left it.
    """

    def __init__(
        self, policy: VLAPolicy, pruners: dict[str, TokenPruner | None], instruction: str | None = None
    ):
        self.network = policy.network
        first, second = _queries(policy, instruction or _own_instruction(policy))
        self._dense = policy.with_pruner(None), second
        self.policies, self.queries = {}, {}
        for name, pruner in pruners.items():
            self.policies[name] = policy.with_pruner(pruner)
            answered = self.policies[name](first.clone(recurse=False))
            remembered = answered.select(*self.policies[name].in_keys, strict=False)
            self.queries[name] = remembered.update(second)

    def answer(self, name: str) -> TensorDictBase:
        """Return a method's output for its policy call."""
        return self.policies[name](self.queries[name].clone(recurse=False))

    def sequence(self) -> LayerState:
        """Return the decoder's input, [1, S], in a dense policy call."""
        policy, query = self._dense
        return _recorded(policy, _FirstLayer(), query).scored[0][0]

    def parts(self) -> dict[str, Callable[[], Any]]:
        """Return the parts of a dense policy call, without reading and assembling inputs: name -> call."""
        network, sequence, engine = self.network, self.sequence(), self._dense[0].current_engine()
        images = torch.stack([self._dense[1][camera] for camera in network.config.cameras], 1)
        readout = sequence.hidden[:, : network.config.num_slots].contiguous()
        later = {
            "decoder layers": lambda: network.decoder(sequence, run=engine.run_layers),
            "action head": lambda: engine.read_actions(readout),
        }
        if engine is not network:
            return {"vision towers and projector": lambda: engine.visual_tokens(images), **later}
        frames = images.flatten(0, 1)
        features = network.vision(frames)
        towers = {"vision towers": lambda: network.vision(frames)}
        return towers | {"projector": lambda: network.projector(features)} | later

    def record(self, name: str) -> _Recorder:
        """Record the pruner's inputs in a method's policy call."""
        return _recorded(self.policies[name], self.policies[name].pruner, self.queries[name])

    def helpers(self, name: str) -> dict[str, Callable[[], Any]]:
        """Return a pruner's own work in its policy call: name -> call. ``choosing`` is all of it, ``comparing`` included."""
        recorder = self.record(name)
        calls = {"choosing": recorder.choose}
        if set(FRAME_KEYS) <= set(recorder.in_keys):
            spec = self.network.config.visual_spec
            calls["comparing"] = lambda: compare_frames(recorder.start.clone(recurse=False), spec)
        if recorder.scored:
            calls["scoring"] = partial(recorder.score, self.network.config.llm.heads)
        if any(keep is not None for _, keep in recorder.answered):
            calls["gathering"] = recorder.gather
        return calls


class _FirstLayer(TokenPruner):
    """Prunes nothing and has its first layer scored, which shows the decoder's input."""

    def layers_scored(self, num_layers: int) -> set[int]:
        return {0}


class _Recorder(TokenPruner):
    """Does what another pruner does, notes what it worked on, and does it again."""

    def __init__(self, inner: TokenPruner):
        self.inner = inner
        self.in_keys, self.out_keys = inner.in_keys, inner.out_keys
        for name in ("bind", "layers_scored", "layers_skipped", "end"):
            setattr(self, name, getattr(inner, name))
        self.start: TensorDictBase
        self.embedded: LayerState
        self.scored: list[tuple[LayerState, Tensor]] = []
        self.answered: list[tuple[LayerState, Tensor | None]] = []

    def begin(self, td: TensorDictBase) -> None:
        self.start = td.clone(recurse=False)
        self.inner.begin(td)

    def before_layers(self, state: LayerState) -> None:
        self.embedded = replace(state)
        self.inner.before_layers(state)

    def score_rows(self, state: LayerState) -> Tensor:
        rows = self.inner.score_rows(state)
        self.scored.append((replace(state), rows))
        return rows

    def after_layer(self, index: int, state: LayerState) -> Tensor | None:
        before = replace(state)
        keep = self.inner.after_layer(index, state)
        self.answered.append((before, keep))
        return keep

    def choose(self) -> None:
        """Do all of the pruner's own work."""
        td = self.start.clone(recurse=False)
        self.inner.begin(td)
        self.inner.before_layers(replace(self.embedded, td=td))
        for state, _ in self.scored:
            self.inner.score_rows(replace(state, td=td))
        for state, _ in self.answered:
            self.inner.after_layer(state.layer, replace(state, td=td))
        self.inner.end(td)

    def score(self, heads: int) -> None:
        """Compute the scores of all scored layers, on numbers that are as good as queries and keys."""
        for state, rows in self.scored:
            projected = state.hidden.unflatten(-1, (heads, -1)).transpose(1, 2)
            visual_scores(state, projected, projected, rows)

    def gather(self) -> None:
        """Build the shorter sequences of all layers that dropped tokens."""
        for state, keep in self.answered:
            if keep is not None:
                pack(state, state.alive & (keep | ~state.is_visual))


def _recorded(policy: VLAPolicy, pruner: TokenPruner, query: TensorDictBase) -> _Recorder:
    """Record what ``pruner`` does in a policy call of this model."""
    recorder = _Recorder(pruner)
    policy.with_pruner(recorder)(query.clone(recurse=False))
    return recorder


def _own_instruction(policy: VLAPolicy) -> str:
    """Return what the policy was trained on: words that a small tokenizer does not know would be spelled, and take longer."""
    task = TASKS.get(policy.source.task)
    return task.instructions[0] if isinstance(task, RobosuiteTask) else _INSTRUCTION


def _queries(policy: VLAPolicy, instruction: str) -> tuple[TensorDict, TensorDict]:
    """Make the first two policy calls of an episode, [1]: noise for images, and the same with some patches drawn again."""
    config, generator = policy.network.config, torch.Generator().manual_seed(0)
    size, rows = (1, 3, config.image_size, config.image_size), config.grid[0]
    first = TensorDict({keys.INSTRUCTION: [instruction]}, [1])
    first[keys.STATE] = torch.rand(1, config.state_dim, generator=generator)
    first[keys.IS_INIT] = torch.ones(1, 1, dtype=torch.bool)
    second = first.clone()
    second[keys.IS_INIT] = torch.zeros(1, 1, dtype=torch.bool)
    for camera in config.cameras:
        before, after = (torch.randint(256, size, generator=generator, dtype=torch.uint8) for _ in range(2))
        changed = torch.rand(rows, rows, generator=generator) < _CHANGED
        changed = changed.repeat_interleave(config.patch_size, 0).repeat_interleave(config.patch_size, 1)
        first[camera], second[camera] = before, torch.where(changed, after, before)
    device = next(policy.network.parameters()).device
    return first.to(device), second.to(device)
