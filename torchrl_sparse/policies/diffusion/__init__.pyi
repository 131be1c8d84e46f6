from .policy import DiffusionPolicy as DiffusionPolicy
from .warm_start import WarmStart as WarmStart
