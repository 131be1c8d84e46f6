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
    "TransformerForDiffusion": "networks.diffusion.transformer",
    "Sampler": "networks.diffusion.sampler",
    "VLAPolicy": "policies.vla.policy",
    "VLAConfig": "networks.vla.config",
    "TokenPruner": "networks.vla.pruning",
    "load_openvla_oft": "storage.published.openvla_oft",
    "Normalizer": "networks.normalize",
    "Planner": "blocks.planner",
    "StaticPlanner": "blocks.planner",
    "Dense": "blocks.planner",
    "Uniform": "blocks.uniform",
    "CacheSchedule": "blocks.schedule",
    "SchedulePlanner": "blocks.schedule",
    "BAC": "blocks.bac",
    "SAGPruner": "blocks.sag.planner",
    "make_engine": "blocks.engine.factory",
    "SpecPrune": "tokens.specprune",
    "ActionAwareController": "control.action_aware",
    "ChunkExecutor": "control.chunk_executor",
    "RealtimeExecutor": "control.realtime_executor",
    "rollout_episodes": "evaluation.rollouts.paired",
    "measure_latency": "evaluation.latency.measure",
}

__all__ = [*_HOME]

if TYPE_CHECKING:
    from torchrl_sparse.blocks.bac import BAC
    from torchrl_sparse.blocks.engine.factory import make_engine
    from torchrl_sparse.blocks.planner import Dense, Planner, StaticPlanner
    from torchrl_sparse.blocks.sag.planner import SAGPruner
    from torchrl_sparse.blocks.schedule import CacheSchedule, SchedulePlanner
    from torchrl_sparse.blocks.uniform import Uniform
    from torchrl_sparse.control.action_aware import ActionAwareController
    from torchrl_sparse.control.chunk_executor import ChunkExecutor
    from torchrl_sparse.control.realtime_executor import RealtimeExecutor
    from torchrl_sparse.envs.robosuite import RobosuiteEnv
    from torchrl_sparse.envs.transforms import EndEffectorVelocity, make_env
    from torchrl_sparse.evaluation.latency.measure import measure_latency
    from torchrl_sparse.evaluation.rollouts.paired import rollout_episodes
    from torchrl_sparse.networks.diffusion.sampler import Sampler
    from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
    from torchrl_sparse.networks.normalize import Normalizer
    from torchrl_sparse.networks.vla.config import VLAConfig
    from torchrl_sparse.networks.vla.pruning import TokenPruner
    from torchrl_sparse.policies.diffusion.policy import DiffusionPolicy
    from torchrl_sparse.policies.vla.policy import VLAPolicy
    from torchrl_sparse.storage.published.openvla_oft import load_openvla_oft
    from torchrl_sparse.tokens.specprune import SpecPrune


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
