"""Sparse, fast robot policies as TensorDictModules for TorchRL.

Importing the package is light: each name below is imported from its module when it is first used, so that what
needs a simulator costs nothing to those who do not.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOME = {
    "RobosuiteEnv": "envs.robosuite",
    "make_env": "envs.transforms",
    "EndEffectorVelocity": "envs.transforms",
    "DiffusionPolicy": "policies.diffusion.policy",
    "TransformerForDiffusion": "policies.diffusion.transformer",
    "NoiseSchedule": "policies.diffusion.schedule",
    "VLAPolicy": "policies.vla.policy",
    "VLAConfig": "policies.vla.config",
    "TokenPruner": "policies.vla.pruning",
    "load_openvla_oft": "policies.checkpoints.openvla_oft",
    "Normalizer": "data.normalize",
    "Planner": "blocks.planner",
    "StaticPlanner": "blocks.planner",
    "Dense": "blocks.planner",
    "Uniform": "blocks.uniform",
    "Schedule": "blocks.static",
    "StaticSchedule": "blocks.static",
    "BAC": "blocks.bac",
    "SAGPruner": "blocks.sag",
    "make_engine": "blocks.engine.factory",
    "SpecPrune": "tokens.specprune",
    "ActionAwareController": "control.action_aware",
    "ChunkExecutor": "control.chunk_executor",
    "RealtimeExecutor": "control.realtime_executor",
    "rollout_episodes": "evaluation.paired",
    "measure_latency": "evaluation.latency",
}

__all__ = [*_HOME]

if TYPE_CHECKING:
    from torchrl_sparse.blocks.bac import BAC
    from torchrl_sparse.blocks.engine.factory import make_engine
    from torchrl_sparse.blocks.planner import Dense, Planner, StaticPlanner
    from torchrl_sparse.blocks.sag import SAGPruner
    from torchrl_sparse.blocks.static import Schedule, StaticSchedule
    from torchrl_sparse.blocks.uniform import Uniform
    from torchrl_sparse.control.action_aware import ActionAwareController
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.control.realtime_executor import RealtimeExecutor
    from torchrl_sparse.data.normalize import Normalizer
    from torchrl_sparse.envs.robosuite import RobosuiteEnv
    from torchrl_sparse.envs.transforms import EndEffectorVelocity, make_env
    from torchrl_sparse.evaluation.latency import measure_latency
    from torchrl_sparse.evaluation.paired import rollout_episodes
    from torchrl_sparse.policies.checkpoints.openvla_oft import load_openvla_oft
    from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
    from torchrl_sparse.policies.diffusion.schedule import NoiseSchedule
    from torchrl_sparse.policies.diffusion.transformer import TransformerForDiffusion
    from torchrl_sparse.policies.vla.config import VLAConfig
    from torchrl_sparse.policies.vla.policy import VLAPolicy
    from torchrl_sparse.policies.vla.pruning import TokenPruner
    from torchrl_sparse.tokens.specprune import SpecPrune


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
