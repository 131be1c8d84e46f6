from .policy import DiffusionPolicy as DiffusionPolicy
from .realtime_chunking import RealtimeChunking as RealtimeChunking
from .warm_start import WarmStart as WarmStart
