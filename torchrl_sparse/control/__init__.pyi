from .action_aware import (
    ActionAwareController as ActionAwareController,
    Thresholds as Thresholds,
)
from .chunk_executor import ChunkExecutor as ChunkExecutor
from .queries import (
    answer as answer,
    record_queries as record_queries,
)
from .realtime_executor import (
    HoldPose as HoldPose,
    RealtimeExecutor as RealtimeExecutor,
)
from .roll_forward import (
    RollForward as RollForward,
    StateModel as StateModel,
)
from .selectors import CoherentChunk as CoherentChunk
from .temporal_ensemble import TemporalEnsemble as TemporalEnsemble
