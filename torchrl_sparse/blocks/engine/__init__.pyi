from .base import Engine as Engine
from .costs import BlockCost as BlockCost
from .factory import (
    ENGINES as ENGINES,
    EngineEntry as EngineEntry,
    EngineName as EngineName,
    make_engine as make_engine,
)
from .native import (
    NativeEngine as NativeEngine,
    native_available as native_available,
)
from .reference import (
    FeatureRecorder as FeatureRecorder,
    ReferenceEngine as ReferenceEngine,
    denoise as denoise,
)
from .torch import TorchEngine as TorchEngine
