from .loss import DiffusionLoss as DiffusionLoss
from .targets import make_targets as make_targets
from .timesteps import search_timesteps as search_timesteps
from .trainer import PolicyTrainer as PolicyTrainer
