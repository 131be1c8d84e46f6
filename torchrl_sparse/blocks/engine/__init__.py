"""Engines: how a prune mask becomes skipped work."""

from torchrl_sparse.blocks.engine.reference import FeatureRecorder, denoise

__all__ = ["FeatureRecorder", "denoise"]
