"""Sparsity over (denoising step × block): what to skip (planners) and how it is skipped (engines)."""

from torchrl_sparse.blocks.bac import BAC
from torchrl_sparse.blocks.engine.reference import denoise
from torchrl_sparse.blocks.planner import Dense, Planner, PlanSpec, StaticPlanner
from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
from torchrl_sparse.blocks.uniform import Uniform

__all__ = [
    "BAC",
    "Dense",
    "PlanSpec",
    "Planner",
    "CacheSchedule",
    "StaticPlanner",
    "SchedulePlanner",
    "Uniform",
    "denoise",
]
