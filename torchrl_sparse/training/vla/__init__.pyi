from .token_budget import TokenBudget as TokenBudget
from .trainer import VLATrainer as VLATrainer
