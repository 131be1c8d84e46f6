from .trainer import (
    PrunerConfig as PrunerConfig,
    PrunerTrainer as PrunerTrainer,
)
