from .loss import DiffusionLoss as DiffusionLoss
from .timesteps import search_timesteps as search_timesteps
from .trainer import PolicyTrainer as PolicyTrainer
