"""Engines: how a prune mask becomes skipped work."""

from torchrl_sparse.blocks.engine.base import Engine, ReferenceEngine
from torchrl_sparse.blocks.engine.costs import BlockCost
from torchrl_sparse.blocks.engine.factory import EngineName, make_engine
from torchrl_sparse.blocks.engine.native.engine import NativeEngine
from torchrl_sparse.blocks.engine.native.library import native_available
from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise
from torchrl_sparse.blocks.engine.torch.engine import TorchEngine

__all__ = [
    "BlockCost",
    "Engine",
    "EngineName",
    "FeatureRecorder",
    "NativeEngine",
    "ReferenceEngine",
    "TorchEngine",
    "denoise",
    "make_engine",
    "native_available",
]
