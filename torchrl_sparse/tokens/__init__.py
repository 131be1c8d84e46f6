"""Sparsity over visual tokens: which patches of the cameras' images a vision-language-action model goes on computing."""

from torchrl_sparse.tokens.efficientvla import EfficientVLAPruner
from torchrl_sparse.tokens.fastv import FastVPruner
from torchrl_sparse.tokens.frame_difference import FrameDifferencePruner
from torchrl_sparse.tokens.random import RandomPruner
from torchrl_sparse.tokens.sparsevlm import SparseVLMPruner
from torchrl_sparse.tokens.specprune import SpecPrune
from torchrl_sparse.tokens.vla_cache import VLACachePruner

__all__ = [
    "EfficientVLAPruner",
    "FastVPruner",
    "FrameDifferencePruner",
    "RandomPruner",
    "SparseVLMPruner",
    "SpecPrune",
    "VLACachePruner",
]
