"""Observation encoder of the denoiser's condition: camera features, then normalised states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_sparse import keys
from torchrl_sparse.carried import TensorKeys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.diffusion.clip_encoder import ClipEncoder
from torchrl_sparse.networks.diffusion.denoiser import Denoiser
from torchrl_sparse.networks.diffusion.noise import check_whole, query_seed
from torchrl_sparse.networks.diffusion.vision import VisionEncoder
from torchrl_sparse.networks.normalize import Normalizer
from torchrl_sparse.policies.diffusion.cameras import CameraSlot

__all__ = ["ConditionEncoder", "ObservationEncoder"]


class ConditionEncoder(TensorKeys, nn.Module):
    """Computes the condition f32 [*B, To, D] of observations; D is the size of features, instruction and state together.

    Args:
        normalizer: of states.
        vision: encoder of the cameras; None reads the state alone.

    Attributes:
        bf16: whether the cameras' encoder rounds to bfloat16 in use; False unless another is assigned.
        in_keys: ``("history", "state")`` f32 [*B, To, Ds], and ``("history", name)``
            u8 [*B, To, 3, h, w] of each camera; with cameras, also what the policy call before left of them,
            ``("diffusion", "frame_features")``, and the steps since, ``("control", "elapsed")``, if they are there. Where the
            encoder reads instructions, ``"language_instruction"``, if it is there.
    """

    tensor_keys = {"state": keys.STATE}

    def __init__(self, normalizer: Normalizer, vision: VisionEncoder | ClipEncoder | None = None) -> None:
        super().__init__()
        self.normalizer, self.vision = normalizer, vision
        self.cameras, self.bf16 = CameraSlot(), False

    @property
    def state_key(self) -> NestedKey:
        """Key of the state history, derived from the environment's key."""
        return keys.history_of(self.tensor_keys["state"])

    @property
    def in_keys(self) -> list[NestedKey]:
        if self.vision is None:
            return [self.state_key]
        cameras = [keys.history(name) for name in self.vision.cameras]
        texts = [keys.INSTRUCTION] if self.vision.text_dim else []
        return [self.state_key, *cameras, keys.ELAPSED, keys.FRAME_FEATURES, *texts]

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """Encode one batch of observations.

        Raises:
            KeyError: if an observation is missing.
            InputError: if images do not fit the encoder.
        """
        state = self.normalizer.normalize_state(keys.read(tensordict, self.state_key))
        if self.vision is None:
            return state
        images = {name: keys.read(tensordict, keys.history(name)) for name in self.vision.cameras}
        parts = []
        if images:
            encode = self.cameras.get(self.vision, frames=state.shape[-2], bf16=self.bf16)
            parts.append(self._features(tensordict, images, encode))
        if isinstance(self.vision, ClipEncoder):
            told = _instructions(tensordict, self.vision.instruction)
            features = self.vision.text_features(told)
            parts.append(features.view(*tensordict.batch_size, 1, -1).expand(*state.shape[:-1], -1))
        return torch.cat([*parts, state], dim=-1)

    def _features(
        self, tensordict: TensorDictBase, images: dict[str, Tensor], encode: Callable[..., Tensor]
    ) -> Tensor:
        """Return the features of the frames, [*B, To, F]; those that the policy call before has encoded are taken from it."""
        known, elapsed = tensordict.get(keys.FRAME_FEATURES, None), tensordict.get(keys.ELAPSED, None)
        if known is None or elapsed is None or self.training:
            return encode(images)
        # Where each frame lay in the history of the policy call before.
        place = torch.arange(known.shape[-2], device=known.device) + elapsed
        fresh = (elapsed == 0) | (place >= known.shape[-2])
        if fresh.all():
            return encode(images)
        features = known.gather(-2, place.clamp(max=known.shape[-2] - 1)[..., None].expand_as(known))
        features[fresh] = encode({name: frames[fresh] for name, frames in images.items()})
        return features


class ObservationEncoder(TensorDictModuleBase):
    """Module that writes the denoiser's condition and the noise seed of the policy call.

    Args:
        network: the denoiser, for the sizes.
        normalizer: of states.
        vision: encoder of the cameras, if there are any.

    Attributes:
        state_shape: (To, Ds).
        noise_stream: which of the noises that an episode could have had; 0 unless another is assigned.

    Raises:
        InputError: if features and state together are not what the network expects.
    """

    def __init__(
        self, network: Denoiser, normalizer: Normalizer, vision: VisionEncoder | ClipEncoder | None = None
    ) -> None:
        super().__init__()
        self.condition = ConditionEncoder(normalizer, vision)
        self.out_keys = [keys.COND, keys.SEED, *(() if vision is None else (keys.FRAME_FEATURES,))]
        features = 0 if vision is None else vision.feature_dim + vision.text_dim
        state = len(normalizer.state_scale)
        if features + state != network.cond_dim:
            raise InputError(
                f"network: expected cond_dim {features + state} (features {features}, state {state}), "
                f"got {network.cond_dim}"
            )
        self.state_shape = (network.n_obs_steps, state)
        self.noise_stream = 0

    @property
    def in_keys(self) -> list[NestedKey]:
        return [*self.condition.in_keys, keys.EPISODE_SEED, keys.EPISODE_STEP]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check(keys.read(tensordict, self.condition.state_key))
        # In use, weights of the cameras' networks are no reason to keep a graph; observations still are.
        encoder = self.condition.vision
        frozen = encoder is not None and not self.training
        with torch.set_grad_enabled(torch.is_grad_enabled() and not frozen):
            tensordict.set(keys.COND, self.condition(tensordict))
        if encoder is not None:
            tensordict.set(keys.FRAME_FEATURES, tensordict.get(keys.COND)[..., : encoder.feature_dim].clone())
        return tensordict.set(keys.SEED, self.seed(tensordict))

    def take_over(self, other: ObservationEncoder) -> None:
        """Adopt the noise, the keys and the packed camera weights of ``other``."""
        self.condition.set_keys(**other.condition.tensor_keys)
        self.noise_stream, self.condition.cameras = other.noise_stream, other.condition.cameras

    def refresh(self) -> None:
        """Read the encoders' weights again in the next policy call."""
        self.condition.cameras.refresh()
        if isinstance(self.condition.vision, ClipEncoder):
            self.condition.vision.refresh()

    def _check(self, state: Tensor) -> None:
        key = self.condition.state_key
        if tuple(state.shape[-2:]) != self.state_shape:
            raise InputError(
                f"{key}: expected [*B, n_obs_steps, state] = [*B, {self.state_shape[0]}, "
                f"{self.state_shape[1]}], got {list(state.shape)}"
            )
        if state.is_meta or state.is_complex() or state.layout != torch.strided:
            raise InputError(
                f"{key}: expected real numbers in memory, got {state.dtype} {state.layout} on {state.device}"
            )
        if not state.isfinite().all():
            bad = (~state.isfinite()).nonzero()[0].tolist()
            raise InputError(f"{key}: expected finite numbers, got {state[tuple(bad)]} at {bad}")

    def seed(self, tensordict: TensorDictBase) -> Tensor:
        """Return the noise seed of each policy call, i64 [*B, 1]."""
        seed, step = tensordict.get(keys.EPISODE_SEED, None), tensordict.get(keys.EPISODE_STEP, None)
        if seed is None or step is None:
            return torch.randint(2**62, (*tensordict.batch_size, 1), device=tensordict.device)
        check_whole(keys.EPISODE_SEED, seed)
        check_whole(keys.EPISODE_STEP, step)
        return query_seed(seed, step, self.noise_stream)


def _instructions(tensordict: TensorDictBase, usual: str | None) -> list[str]:
    """Return the instruction of each row, the usual one if none is written; ValueError for another number of them."""
    rows, value = tensordict.batch_size.numel(), tensordict.get(keys.INSTRUCTION, None)
    if value is None:
        value = usual
    found = _texts(value.tolist() if hasattr(value, "tolist") else value)
    found = found * rows if len(found) == 1 else found
    if len(found) != rows or not all(isinstance(text, str) for text in found):
        raise InputError(
            f"{keys.INSTRUCTION}: expected the text of each of {rows} rows, or a policy of one task "
            f"(DiffusionPolicy.from_lerobot(folder, task=...)), got {value!r}"
        )
    return found


def _texts(value: Any) -> list:
    if isinstance(value, (list, tuple)):
        return [text for item in value for text in _texts(item)]
    return [value]
