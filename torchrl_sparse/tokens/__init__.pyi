from .base import TokenPruner as TokenPruner
from .dense_first import DenseFirst as DenseFirst
from .efficientvla import (
    EfficientVLAPruner as EfficientVLAPruner,
    LayerSimilarity as LayerSimilarity,
    redundant_layers as redundant_layers,
)
from .fastv import FastVPruner as FastVPruner
from .frame_difference import FrameDifferencePruner as FrameDifferencePruner
from .random import RandomPruner as RandomPruner
from .sparsevlm import SparseVLMPruner as SparseVLMPruner
from .specprune import (
    SpecPrune as SpecPrune,
    SpecPruneOptions as SpecPruneOptions,
)
from .vla_cache import VLACachePruner as VLACachePruner
