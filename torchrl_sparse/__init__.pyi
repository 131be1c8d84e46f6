from . import keys as keys
from .blocks import (
    BAC as BAC,
    CacheSchedule as CacheSchedule,
    Calibration as Calibration,
    Dense as Dense,
    Planner as Planner,
    PlanSpec as PlanSpec,
    SAGPruner as SAGPruner,
    SchedulePlanner as SchedulePlanner,
    StaticPlanner as StaticPlanner,
    Uniform as Uniform,
    bac_schedule as bac_schedule,
    calibrate as calibrate,
    load_planner as load_planner,
    make_engine as make_engine,
)
from .control import (
    ActionAwareController as ActionAwareController,
    ChunkExecutor as ChunkExecutor,
    CoherentChunk as CoherentChunk,
    HoldPose as HoldPose,
    RealtimeExecutor as RealtimeExecutor,
)
from .envs import (
    EndEffectorVelocity as EndEffectorVelocity,
    RobosuiteEnv as RobosuiteEnv,
    make_env as make_env,
)
from .evaluation import (
    measure_latency as measure_latency,
    rollout_episodes as rollout_episodes,
)
from .methods import (
    METHODS as METHODS,
    Method as Method,
    MethodSpec as MethodSpec,
    TokenBudget as TokenBudget,
    make_method as make_method,
)
from .networks import (
    Normalizer as Normalizer,
    Sampler as Sampler,
    TransformerForDiffusion as TransformerForDiffusion,
    VisionEncoder as VisionEncoder,
)
from .networks.vla import VLAConfig as VLAConfig
from .policies import (
    DiffusionPolicy as DiffusionPolicy,
    RealtimeChunking as RealtimeChunking,
    VLAPolicy as VLAPolicy,
    WarmStart as WarmStart,
)
from .tokens import (
    EfficientVLAPruner as EfficientVLAPruner,
    FastVPruner as FastVPruner,
    FrameDifferencePruner as FrameDifferencePruner,
    RandomPruner as RandomPruner,
    SparseVLMPruner as SparseVLMPruner,
    SpecPrune as SpecPrune,
    TokenPruner as TokenPruner,
    VLACachePruner as VLACachePruner,
)

__version__: str
