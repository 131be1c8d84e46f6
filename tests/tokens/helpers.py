"""A small vision-language-action policy, policy calls for it, and a pruner that records another one."""

from dataclasses import replace

import torch
from tensordict import TensorDict

from torchrl_sparse import keys
from torchrl_sparse.networks.vla.config import TransformerSize, VLAConfig
from torchrl_sparse.networks.vla.network import VLANetwork
from torchrl_sparse.policies.vla.policy import VLAPolicy
from torchrl_sparse.tokens.base import TokenPruner
from torchrl_sparse.tokens.dense_first import DenseFirst
from torchrl_sparse.tokens.efficientvla import EfficientVLAPruner
from torchrl_sparse.tokens.fastv import FastVPruner
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.sparsevlm import SparseVLMPruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.tokens.vla_cache import VLACachePruner

SIZE = 56  # pixels: 4 x 4 patches of each of two cameras
PER_CAMERA = 16
LAYERS = 6
CONFIG = VLAConfig.tiny(image_size=SIZE, llm=TransformerSize(32, LAYERS, 2, 64))
SPEC = CONFIG.visual_spec
INSTRUCTIONS = ["lift the cube", "put it down", "stack the red block on the green one", "go"]

PRUNERS = {
    "specprune": lambda: SpecPrune(budget=4),
    "release": lambda: SpecPrune("release", budget=3, static_share=(0.7, 0.9), dynamic=True),
    "fastv": FastVPruner,
    "sparsevlm": SparseVLMPruner,
    "vla_cache": VLACachePruner,
    "efficientvla": lambda: EfficientVLAPruner(skipped=[3]),
    "fastv_dense_first": lambda: DenseFirst(FastVPruner()),
    "random_dense_first": lambda: DenseFirst(RandomPruner()),
    "sparsevlm_dense_first": lambda: DenseFirst(SparseVLMPruner(raters="embeddings")),
    "no_local": lambda: SpecPrune(budget=4, local=False),
    "look_back": lambda: SpecPrune(budget=4, look_back=3),
    "random": RandomPruner,
    "frame_difference": FrameDifferencePruner,
}
"""Every method, made to prune a little of the small model."""

KEEP_ALL = {
    "specprune": lambda: SpecPrune(budget=PER_CAMERA, keep_share=1.0),
    "release": lambda: SpecPrune("release", alpha=1.0, budget=PER_CAMERA, wrist_share=1.0),
    "fastv": lambda: FastVPruner(share=1.0),
    "sparsevlm": lambda: SparseVLMPruner(scale=1e-6),
    "vla_cache": lambda: VLACachePruner(threshold=2.0),
    "efficientvla": lambda: EfficientVLAPruner(share=1.0),
    "fastv_dense_first": lambda: DenseFirst(FastVPruner(share=1.0)),
    "random_dense_first": lambda: DenseFirst(RandomPruner(share=1.0)),
    "sparsevlm_dense_first": lambda: DenseFirst(SparseVLMPruner(scale=1e-6, raters="embeddings")),
    "no_local": lambda: SpecPrune(budget=PER_CAMERA, keep_share=1.0, local=False, threshold=2.0),
    "look_back": lambda: SpecPrune(budget=PER_CAMERA, keep_share=1.0, look_back=3),
    "random": lambda: RandomPruner(share=1.0),
    "frame_difference": lambda: FrameDifferencePruner(share=1.0),
}
"""Every method at the setting at which nothing may change."""


def make_policy(pruner=None):
    torch.manual_seed(0)
    policy = VLAPolicy(VLANetwork(CONFIG))
    policy.pruner = pruner
    return policy


def make_grouped_policies(make_pruner):
    """Two policies of one function: heads that share keys and values, and heads that have the same ones each."""
    torch.manual_seed(0)
    size = TransformerSize(32, LAYERS, 4, 64)
    grouped, each = (VLAPolicy(VLANetwork(replace(CONFIG, llm=size, kv_heads=n))) for n in (2, None))
    weights = grouped.network.state_dict()
    for name in [name for name in weights if "decoder" in name and ("k_proj" in name or "v_proj" in name)]:
        weights[name] = weights[name].unflatten(0, (2, -1)).repeat_interleave(2, dim=0).flatten(0, 1)
    each.network.load_state_dict(weights)
    grouped.pruner, each.pruner = make_pruner(), make_pruner()
    return grouped, each


def query(batch=3, seed=0):
    """The first policy call of ``batch`` episodes, with noise for images."""
    generator = torch.Generator().manual_seed(seed)
    td = TensorDict({keys.INSTRUCTION: INSTRUCTIONS[:batch]}, [batch])
    for camera in SPEC.cameras:
        td[camera] = torch.randint(0, 256, (batch, 3, SIZE, SIZE), generator=generator, dtype=torch.uint8)
    td[keys.STATE] = torch.randn(batch, CONFIG.state_dim, generator=generator)
    td[keys.EEF_VEL] = torch.zeros(batch, 6)
    td[keys.IS_INIT] = torch.ones(batch, 1, dtype=torch.bool)
    td[keys.EPISODE_SEED] = torch.arange(batch)[:, None] + 10
    td[keys.EPISODE_STEP] = torch.zeros(batch, 1, dtype=torch.int64)
    return td


def patch(camera, index):
    """Where patch ``index`` of a camera's images is, as an index into them."""
    row, column = divmod(index, SPEC.grid[1])
    size = SIZE // SPEC.grid[0]
    return (..., slice(row * size, (row + 1) * size), slice(column * size, (column + 1) * size))


def later(td, changed=None, seed=1):
    """The next policy call of the same episodes: everything that the policy wrote is there, and some patches have changed.

    Args:
        changed: patches that changed, as (camera, index) with camera 0 or 1; by default the upper half of the first camera.
    """
    td = td.clone()
    generator = torch.Generator().manual_seed(seed)
    td[keys.IS_INIT] = torch.zeros_like(td[keys.IS_INIT])
    td[keys.EPISODE_STEP] = td[keys.EPISODE_STEP] + 8
    for camera, index in [(0, i) for i in range(8)] if changed is None else changed:
        image = td[SPEC.cameras[camera]]
        area = image[patch(camera, index)]
        image[patch(camera, index)] = torch.randint(
            0, 256, area.shape, generator=generator, dtype=torch.uint8
        )
    return td


class Recorder(TokenPruner):
    """Delegates to another pruner and records the sequence that each layer worked on."""

    def __init__(self, inner):
        self.inner, self.seen = inner, []
        self.in_keys, self.out_keys = inner.in_keys, inner.out_keys
        for name in (
            "bind",
            "layers_scored",
            "layers_skipped",
            "begin",
            "before_layers",
            "score_rows",
            "end",
        ):
            setattr(self, name, getattr(inner, name))

    def after_layer(self, index, state):
        self.seen.append((state.positions.clone(), state.kind.clone(), state.alive.clone()))
        return self.inner.after_layer(index, state)
