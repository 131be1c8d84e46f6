from .diffusion import (
    DiffusionPolicy as DiffusionPolicy,
    WarmStart as WarmStart,
)
from .vla import VLAPolicy as VLAPolicy
