from .policy import DiffusionPolicy as DiffusionPolicy
