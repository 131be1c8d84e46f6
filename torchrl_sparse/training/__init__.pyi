from .demonstrations import TrainConfig as TrainConfig
from .diffusion import (
    DiffusionLoss as DiffusionLoss,
    PolicyTrainer as PolicyTrainer,
)
from .loop import train as train
from .pruner import (
    PrunerConfig as PrunerConfig,
    PrunerTrainer as PrunerTrainer,
)
from .state_model import fit_state_model as fit_state_model
from .trainer import Trainer as Trainer
from .vla import (
    VLATrainer as VLATrainer,
)
