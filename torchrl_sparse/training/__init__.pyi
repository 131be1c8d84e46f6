from .diffusion import (
    DiffusionLoss as DiffusionLoss,
    PolicyTrainer as PolicyTrainer,
)
from .loop import (
    make_logger as make_logger,
    train as train,
)
from .pruner import (
    PrunerConfig as PrunerConfig,
    PrunerTrainer as PrunerTrainer,
)
from .trainer import (
    TrainConfig as TrainConfig,
    Trainer as Trainer,
)
from .vla import (
    VLATrainer as VLATrainer,
)
