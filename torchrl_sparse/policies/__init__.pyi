from .diffusion import DiffusionPolicy as DiffusionPolicy
from .vla import VLAPolicy as VLAPolicy
