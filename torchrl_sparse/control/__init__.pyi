from .action_aware import (
    ActionAwareController as ActionAwareController,
    Thresholds as Thresholds,
)
from .chunk_executor import ChunkExecutor as ChunkExecutor
from .realtime_executor import (
    HoldPose as HoldPose,
    RealtimeExecutor as RealtimeExecutor,
)
