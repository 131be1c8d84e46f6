"""OpenVLA-OFT as a TorchRL policy: camera images, state and instruction in; a chunk of actions and its costs out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.modules.vla import VLAWrapperBase

from torchrl_sparse import keys
from torchrl_sparse.errors import InputError
from torchrl_sparse.networks.vla.adapters import fold_adapters
from torchrl_sparse.networks.vla.config import VLAConfig
from torchrl_sparse.networks.vla.decoder import Decoded
from torchrl_sparse.networks.vla.flops import query_flops
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.networks.vla.normalize import QuantileNormalizer
from torchrl_sparse.networks.vla.text import InstructionTokenizer, WordTokenizer
from torchrl_sparse.networks.vla.vision import center_crop
from torchrl_sparse.policies.vla.engine import RunsInEngine, VLAEngineSlot
from torchrl_sparse.policies.vla.inputs import (
    read_images,
    read_instructions,
    read_keep_mask,
    read_query,
    read_state,
)
from torchrl_sparse.policies.vla.sizes import VLASizes
from torchrl_sparse.runtime.clock import synchronised_clock
from torchrl_sparse.storage.published.openvla_oft import Unsaid, is_openvla_oft, read_openvla_oft
from torchrl_sparse.storage.published.openvla_statistics import Normalization
from torchrl_sparse.storage.vla import AdaptedBase, StoredVLA, VLASource, read_vla, write_vla
from torchrl_sparse.tokens.base import TokenPruner

__all__ = ["VLAPolicy"]


class VLAPolicy(VLASizes, RunsInEngine, VLAWrapperBase):
    """A vision-language-action policy of the OpenVLA-OFT architecture (arXiv:2502.19645).

    Reads the images of ``config.cameras``, u8 [*B, 3, image_size, image_size], upright; ``("observation", "state")``, f32
    [*B, Ds]; ``"language_instruction"``, text; and, where it is there, ``("tokens", "keep_mask")``. Writes the chunk in
    environment units, ``("tokens", "depth")``, ``("tokens", "kept")``, FLOPs actually spent, latency, and what the pruner
    declares.

    Args:
        network: the network.
        normalizer: of states and actions; by default they stay as they are.
        tokenizer: of instructions; by default one that knows the words of the prompt alone, and spells all others.
        engine: what computes the network, see `VLAEngineSlot`: ``"openvino"`` (an extra), ``"torch"``, or ``"auto"``, the first
            that applies. Actions are the same up to rounding. Where gradients may be asked for it is always PyTorch.

    Attributes:
        source: what it was trained for.
        base: the language model whose adapters are trained; None where there are none.
        pruner: the `TokenPruner`. Assign another to change the method, or None for the dense policy.

    Raises:
        KeyError: if a camera or the state is missing; the message names the key and those that are there.
        TypeError: if an instruction is not text.
        InputError: if the batch is empty, an entry has a wrong shape or type, or the tokenizer more ids than the network.

    Examples:
        >>> policy = VLAPolicy(VLANetwork(VLAConfig.tiny()))
        >>> image = torch.zeros(4, 3, 28, 28, dtype=torch.uint8)
        >>> observation = {"image": image, "wrist_image": image, "state": torch.zeros(4, 8)}
        >>> td = TensorDict({"observation": observation, "language_instruction": ["lift the cube"] * 4}, [4])
        >>> policy(td)["vla_action", "chunk"].shape
        torch.Size([4, 2, 7])
    """

    def __init__(
        self,
        network: VLANetwork,
        normalizer: QuantileNormalizer | None = None,
        tokenizer: InstructionTokenizer | None = None,
        engine: str = "auto",
    ):
        config = network.config
        primary, *others = config.cameras
        super().__init__(
            action_dim=config.action_dim,
            chunk_size=config.chunk_size,
            return_vla_action_container=False,
            image_key=primary,
            wrist_image_key=others[0] if others else None,
        )
        self.network = network
        self.normalizer = normalizer or QuantileNormalizer.identity(config.state_dim, config.action_dim)
        self.tokenizer = WordTokenizer(()) if tokenizer is None else tokenizer
        if self.tokenizer.vocab_size > config.vocab_size:
            raise InputError(
                f"tokenizer: expected at most vocab_size={config.vocab_size} ids, got {self.tokenizer.vocab_size}"
            )
        self._slot = VLAEngineSlot(engine)
        self.pruner, self.source = None, VLASource()
        self.base: AdaptedBase | None = None
        self.eval()

    # -- the pruner ----------------------------------------------------------------------------------------------------

    @property
    def pruner(self) -> TokenPruner | None:
        """Pruner of visual tokens; None is dense."""
        return self._pruner

    @pruner.setter
    def pruner(self, pruner: TokenPruner | None) -> None:
        if pruner is not None:
            pruner.bind(self.network.config.visual_spec)
        self._pruner = pruner
        self._update_keys()

    def with_pruner(self, pruner: TokenPruner | None) -> VLAPolicy:
        """Return a policy with the same network and another pruner.

        Raises:
            InputError: if the pruner does not fit the network.
        """
        policy = VLAPolicy(self.network, self.normalizer, self.tokenizer)
        policy.pruner, policy.source, policy.base = pruner, self.source, self.base
        policy._slot = self._slot  # what is compiled serves both
        return policy

    def __setattr__(self, name: str, value: Any) -> None:
        # nn.Module registers any module that is assigned, so that of itself the setter would never see a pruner that is one.
        if name == "pruner":
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    def _update_keys(self) -> None:
        """Declare the pruner's keys and ours beside TorchRL's."""
        super()._update_keys()
        pruner = getattr(self, "_pruner", None)
        wrist = self.tensor_keys.wrist_image
        read, written = (pruner.in_keys, pruner.out_keys) if pruner else ((), ())
        masked = [] if keys.KEEP_MASK in written else [keys.KEEP_MASK]  # a pruner's own is new at every call
        reads = [*([] if wrist is None else [wrist]), *masked, *read]
        writes = [keys.TOKEN_DEPTH, keys.KEPT, *written]
        self.in_keys = list(dict.fromkeys([*self.in_keys, *reads]))
        self.out_keys = list(dict.fromkeys([*self.out_keys, *writes, keys.FLOPS, keys.LATENCY]))

    # -- running it ----------------------------------------------------------------------------------------------------

    def forward(
        self, tensordict: TensorDictBase, *, tensordict_out: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        device = next(self.network.parameters()).device
        start = synchronised_clock(device)
        query = read_query(tensordict, self)
        actions, decoded = self.predict(query)
        answer = self._answer(query, actions, decoded)
        answer.set(keys.LATENCY, torch.full_like(answer.get(keys.FLOPS), synchronised_clock(device) - start))
        return self._output_tensordict(tensordict, answer.reshape(tensordict.batch_size), tensordict_out)

    def _predict_chunk(self, tensordict: TensorDictBase) -> Tensor:
        query = read_query(tensordict, self)
        chunk = self.normalizer.unnormalize_action(self.predict(query)[0])
        return chunk.reshape(*tensordict.batch_size, *chunk.shape[1:])

    def predict(self, query: TensorDictBase) -> tuple[Tensor, Decoded]:
        """Return normalised actions f32 [B, H, A] and the decoder's output for a call [B]; a pruner writes into ``query``."""
        config, names = self.network.config, self.tensor_keys
        images = self.crop_images(query)
        state = read_state(query, names.state, config.state_dim)
        prompts = self.tokenizer.encode(read_instructions(query, names.instruction))
        if self.pruner is not None:
            self.pruner.begin(query)
        actions, decoded = self.network(
            images,
            self.normalizer.normalize_state(state),
            prompts.to(images.device),
            keep_mask=read_keep_mask(query, config.num_visual),
            hooks=self.pruner,
            td=query,
            engine=self.current_engine(),
        )
        if self.pruner is not None:
            self.pruner.end(query)
        return actions, decoded

    def crop_images(self, query: TensorDictBase) -> Tensor:
        """Return cropped images, u8 [B, cameras, 3, h, w]; also replace those in ``query``, whose patches a pruner compares."""
        config, names = self.network.config, self.tensor_keys
        cameras = [names.image, *([] if names.wrist_image is None else [names.wrist_image])]
        images = read_images(query, cameras, config.image_size)
        if config.crop_area < 1:
            images = center_crop(images.flatten(0, 1), config.crop_area).reshape(images.shape)
            for camera, image in zip(cameras, images.unbind(1), strict=True):
                query.set(camera, image)
        return images

    def _answer(self, query: TensorDictBase, actions: Tensor, decoded: Decoded) -> TensorDict:
        """Return all that the policy writes but the latency, [B]."""
        answer = TensorDict({}, query.batch_size, device=query.device)
        answer.set(self.tensor_keys.action_chunk, self.normalizer.unnormalize_action(actions))
        answer.set(keys.TOKEN_DEPTH, decoded.depth)
        ran = (decoded.tokens > 0).sum(1, keepdim=True)
        answer.set(keys.KEPT, decoded.depth.sum(1, keepdim=True) / ran.clamp(min=1))
        answer.set(keys.FLOPS, query_flops(self.network.config, decoded.tokens, decoded.scored)[:, None])
        for key in self.pruner.out_keys if self.pruner is not None else ():
            answer.set(key, keys.read(query, key))
        return answer

    # -- files ---------------------------------------------------------------------------------------------------------

    def save_pretrained(self, path: str | Path) -> None:
        """Write ``config.json`` and fp16 ``model.safetensors`` into the folder ``path``; only the digest of a `base`."""
        stored = StoredVLA(self.network, self.normalizer, self.tokenizer, self.source, self.base)
        write_vla(Path(path), stored)

    @classmethod
    def from_pretrained(
        cls,
        path: str | Path,
        *,
        config: VLAConfig | None = None,
        base: str | Path | None = None,
        fold: bool = True,
        engine: str = "auto",
        **published: Any,
    ) -> VLAPolicy:
        """Load a folder written by `save_pretrained` or published for OpenVLA-OFT. Nothing in the files is executed.

        Args:
            path: the folder.
            config: the architecture that it must hold, for instance with two cameras; any by default.
            base: file of the language model that the policy adapts, where it does.
            fold: adapters are added to the weights that they adapt, to use the policy; False to train it further.
            engine: see the class.
            published: arguments of `from_openvla_oft`, which only such a folder takes.

        Raises:
            FileNotFoundError, InputError: naming the file, what was expected in it and what was found.
        """
        ours = {name: given for name, given in (("base", base), ("config", config)) if given is not None}
        if unread := ours if (released := is_openvla_oft(path)) else published:
            raise InputError(f"{', '.join(unread)}: expected none for {path}, whose own files tell")
        if released:
            return cls.from_openvla_oft(path, engine=engine, **published)
        stored = read_vla(Path(path), config, None if base is None else Path(base))
        if stored.base is not None and fold:
            stored = replace(stored, network=fold_adapters(stored.network), base=None)
        return cls._assemble(stored, engine)

    @classmethod
    def from_openvla_oft(
        cls,
        path: str | Path,
        *,
        unnorm_key: str | None = None,
        cameras: int = 2,
        heads: Sequence[int] = (16, 16, 32),
        chunk_size: int = 8,
        normalization: Normalization = "bounds_q99",
        center_crop: bool = True,
        dtype: torch.dtype | None = None,
        engine: str = "auto",
    ) -> VLAPolicy:
        """Load a published OpenVLA-OFT checkpoint, a folder as on the Hugging Face hub. Nothing in its files is executed.

        The policy reads upright images of the published size and crops them itself. What the published evaluation did to
        LIBERO's images before that belongs to `torchrl_sparse.envs.instructed.instructed_env`: a turn by 180 degrees, and JPEG
        and Lanczos on the way to 224 pixels. The state is position, axis-angle and both fingers.

        Weights stay in the shards, of which the system reads what is used and keeps what there is room for, unless another
        ``dtype`` is asked for or the policy goes to another device. So the files have to stay as they are.

        Args:
            path: the folder, see `torchrl_sparse.storage.published.openvla_oft`; ``engine``: see the class.
            unnorm_key: the data set whose statistics normalise, such as ``"libero_spatial"`` (``"_no_noops"`` is added where
                the file has it so); not needed where the file has one only.
            cameras: images that the checkpoint was trained with, 1 or 2; its files do not say.
            heads: attention heads of DINOv2, SigLIP and the decoder, which cannot be seen in the weights; the published ones.
            chunk_size: actions of a chunk with which it was trained, ``NUM_ACTIONS_CHUNK`` there; 8 is LIBERO's.
            normalization: ``"bounds_q99"``, the quantiles, as LIBERO's constants say, or ``"bounds"``, ``min`` and ``max``.
            center_crop: whether images are cropped to their central 90 %, as where training cropped at random.
            dtype: of the network; by default that of the embeddings in the shards, bf16 where they are as published.

        Raises:
            FileNotFoundError, InputError: naming the file, what was expected in it and what was found.

        Examples:
            >>> policy = VLAPolicy.from_openvla_oft("checkpoint", unnorm_key="libero_spatial")  # doctest: +SKIP
        """
        unsaid = Unsaid(cameras, heads, chunk_size, normalization, center_crop)
        stored = read_openvla_oft(Path(path), unnorm_key=unnorm_key, unsaid=unsaid, dtype=dtype)
        return cls._assemble(stored, engine)

    @classmethod
    def _assemble(cls, stored: StoredVLA, engine: str) -> VLAPolicy:
        policy = cls(stored.network, stored.normalizer, stored.tokenizer, engine)
        policy.source, policy.base = stored.source, stored.base
        return policy
