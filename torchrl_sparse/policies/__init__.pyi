from .diffusion import (
    DiffusionPolicy as DiffusionPolicy,
    RealtimeChunking as RealtimeChunking,
    WarmStart as WarmStart,
)
from .vla import VLAPolicy as VLAPolicy
